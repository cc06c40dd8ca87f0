# The viewer on port 8080, on the CPU, not as root:
#   docker build -t curvireg . && docker run --rm -p 127.0.0.1:8080:8080 curvireg
# The container prints the address; open it with 127.0.0.1 in place of the container's name.
FROM python:3.12-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1 libglib2.0-0 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home curvireg
WORKDIR /app
RUN pip install --no-cache-dir torch --index-url https://download.pytorch.org/whl/cpu
COPY pyproject.toml README.md LICENSE ./
COPY curvireg_torch ./curvireg_torch
RUN pip install --no-cache-dir '.[viewer,plot]'
USER curvireg
ENV CURVIREG_CACHE=/home/curvireg/cache
EXPOSE 8080
ENTRYPOINT ["curvireg"]
CMD ["view", "--host", "0.0.0.0", "--port", "8080", "--no-browser"]
