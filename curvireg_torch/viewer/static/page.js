// Sends files to the server, and what the mouse, the fingers and the keys do on the photograph. The server draws.
(() => {
  // --- Files: chosen, dropped anywhere, or pasted.
  const address = () => location.pathname.replace(/\/$/, "") + "/upload";

  // What belongs to a rig comes after it, and what a mesh names after the mesh.
  const ORDER = [/(^(images\.txt|scene_camera\.json)|\.csv)$/i, /\.(obj|gltf|dae|urdf)$/i, /\.(?!mtl$|bin$)(?!png$|jpe?g$)\w+$/i, /\.mtl$/i];
  const rank = (file) => (ORDER.findIndex((kind) => kind.test(file.name)) + ORDER.length + 1) % (ORDER.length + 1);

  async function sendFiles(files) {
    let first = 1;
    for (const file of files.sort((a, b) => rank(a) - rank(b))) {
      const headers = { "x-file-name": encodeURIComponent(file.name), "x-first": first };
      first = 0;
      await fetch(address(), { method: "POST", body: file, headers }).catch(() => {});  // the server shows the reason
    }
  }

  document.addEventListener("change", (event) => {
    if (event.target.type !== "file") return;
    sendFiles([...event.target.files]).then(() => (event.target.value = ""));  // so that the same file can be chosen again
  });
  addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("dropping");
  });
  addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) document.body.classList.remove("dropping");
  });
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    sendFiles([...event.dataTransfer.files]);
  });
  addEventListener("paste", (event) => sendFiles([...event.clipboardData.files]));

  // --- The photograph: one pointer draws the box or moves the pose. Two pointers and the wheel zoom and pan where the
  // box is corrected; where the pose is, they change its distance and roll it.
  const pointers = new Map();
  let drawing = false, queued = null, pinch = null, scaled = null;

  const canvasOf = (target) => target.closest?.(".canvas");
  const isPose = (canvas) => canvas.dataset.mode === "pose";

  function send(type, event, canvas) {
    const frame = canvas.getBoundingClientRect();
    const reach = (event.pointerType === "touch" ? 22 : 10) / frame.width;
    const [x, y] = [(event.clientX - frame.left) / frame.width, (event.clientY - frame.top) / frame.height];
    emitEvent("stage", { type, x, y, reach });
  }

  function scalePose(factor, roll) {
    if (!scaled) requestAnimationFrame(() => { emitEvent("stage", { type: "scale", ...scaled }); scaled = null; });
    scaled = { factor: (scaled?.factor ?? 1) * factor, roll: (scaled?.roll ?? 0) + roll };
  }

  function zoomTo(canvas, zoom, clientX, clientY) {
    const viewport = canvas.parentElement;
    const before = canvas.getBoundingClientRect();
    const [u, v] = [(clientX - before.left) / before.width, (clientY - before.top) / before.height];
    canvas.dataset.zoom = Math.min(Math.max(zoom, 1), 12);
    canvas.style.width = `${100 * canvas.dataset.zoom}%`;
    const after = canvas.getBoundingClientRect();
    viewport.scrollLeft += after.left + u * after.width - clientX;
    viewport.scrollTop += after.top + v * after.height - clientY;
  }

  const zoomOf = (canvas) => Number(canvas.dataset.zoom || 1);

  addEventListener("wheel", (event) => {
    const canvas = canvasOf(event.target);
    if (!canvas) return;
    if (isPose(canvas)) {
      const turn = event.deltaY || event.deltaX;  // Shift makes it horizontal
      event.shiftKey ? scalePose(1, turn / 20) : scalePose(Math.exp(-turn / 1500), 0);
    } else {
      if (event.shiftKey || (event.deltaY > 0 && zoomOf(canvas) === 1)) return;  // the page scrolls
      zoomTo(canvas, zoomOf(canvas) * Math.exp(-event.deltaY / 400), event.clientX, event.clientY);
    }
    event.preventDefault();
  }, { passive: false });

  const PART_OF_VIEW = 0.6;  // which the object fills after an answer
  const LEAST_ZOOM = 1.1;  // less is not worth the scroll bars

  function zoomToObject(canvas) {
    const [x0, y0, x1, y1] = (canvas.dataset.object || "0 0 1 1").split(" ").map(Number);
    const viewport = canvas.parentElement, frame = viewport.getBoundingClientRect();
    const zoom = PART_OF_VIEW / Math.max(x1 - x0, y1 - y0, 0.05);
    zoomTo(canvas, zoom < LEAST_ZOOM ? 1 : zoom, frame.left, frame.top);
    viewport.scrollLeft = ((x0 + x1) / 2) * canvas.offsetWidth - viewport.clientWidth / 2;
    viewport.scrollTop = ((y0 + y1) / 2) * canvas.offsetHeight - viewport.clientHeight / 2;
  }

  function zoomBy(name) {
    const canvas = document.querySelector(".canvas");
    if (!canvas) return;
    if (name === "fit" && zoomOf(canvas) === 1) return zoomToObject(canvas);
    const frame = canvas.parentElement.getBoundingClientRect();
    const zoom = { in: zoomOf(canvas) * 1.5, out: zoomOf(canvas) / 1.5, fit: 1 }[name];
    zoomTo(canvas, zoom, frame.left + frame.width / 2, frame.top + frame.height / 2);
  }

  addEventListener("click", (event) => {
    if (event.target.matches?.("button[data-zoom]")) zoomBy(event.target.dataset.zoom);
  });
  new MutationObserver((changes) => {
    for (const { attributeName, target } of changes) {
      if (attributeName === "data-answer") zoomToObject(target);
      else zoomTo(target, 1, 0, 0);  // another photograph is shown whole
    }
  }).observe(document.body, { subtree: true, attributeFilter: ["data-answer", "data-photo"] });

  // --- The pointer shows whether a drag would move the mesh or turn it: the server decides by the same outline.
  const outline = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  let opaque = null;

  document.addEventListener("load", (event) => {  // it does not reach the window
    if (!event.target.matches?.(".canvas img:nth-child(2)")) return;
    const [width, height] = [outline.canvas.width, outline.canvas.height] = [480, Math.round((480 * event.target.naturalHeight) / event.target.naturalWidth)];
    outline.drawImage(event.target, 0, 0, width, height);
    const alpha = outline.getImageData(0, 0, width, height).data;
    opaque = (x, y) => x >= 0 && y >= 0 && x < width && y < height && alpha[4 * (y * width + x) + 3] > 0;
  }, true);

  function aim(event, canvas) {
    if (!opaque || event.pointerType === "touch") return;
    const frame = canvas.getBoundingClientRect(), scale = 480 / frame.width, reach = Math.round(10 * scale);
    const [x, y] = [Math.floor((event.clientX - frame.left) * scale), Math.floor((event.clientY - frame.top) * scale)];
    const steps = [-reach, -reach / 2, 0, reach / 2, reach].map(Math.round);
    canvas.dataset.aim = steps.some((dx) => steps.some((dy) => opaque(x + dx, y + dy))) ? "move" : "turn";
  }

  addEventListener("pointerdown", (event) => {
    const canvas = canvasOf(event.target);
    if (!canvas) return;
    pointers.set(event.pointerId, event);
    canvas.setPointerCapture(event.pointerId);
    if (pointers.size === 2) {
      if (drawing) send("cancel", event, canvas);
      drawing = false;
      pinch = spread();
    } else if (pointers.size === 1 && event.button === 0) {
      drawing = true;
      send("press", event, canvas);
      canvas.parentElement.focus({ preventScroll: true });
    }
    event.preventDefault();
  });

  function spread() {
    const [a, b] = [...pointers.values()];
    const [dx, dy] = [b.clientX - a.clientX, b.clientY - a.clientY];
    return {
      x: (a.clientX + b.clientX) / 2, y: (a.clientY + b.clientY) / 2,
      size: Math.hypot(dx, dy) || 1, angle: (Math.atan2(dy, dx) * 180) / Math.PI,
    };
  }

  addEventListener("pointermove", (event) => {
    const canvas = canvasOf(event.target), before = pointers.get(event.pointerId);
    if (canvas && !before && isPose(canvas)) aim(event, canvas);
    if (!canvas || !before) return;
    pointers.set(event.pointerId, event);
    if (pinch && pointers.size === 2) {
      const now = spread();
      if (isPose(canvas)) {
        scalePose(now.size / pinch.size, ((now.angle - pinch.angle + 540) % 360) - 180);
      } else {
        zoomTo(canvas, (zoomOf(canvas) * now.size) / pinch.size, now.x, now.y);
        canvas.parentElement.scrollBy(pinch.x - now.x, pinch.y - now.y);
      }
      pinch = now;
    } else if (event.buttons === 4) {
      canvas.parentElement.scrollBy(before.clientX - event.clientX, before.clientY - event.clientY);
    } else if (drawing) {
      if (!queued) requestAnimationFrame(() => { if (queued && drawing) send("move", queued, canvas); queued = null; });
      queued = event;
    }
  });

  function release(event) {
    const canvas = canvasOf(event.target);
    if (!pointers.delete(event.pointerId) || !canvas) return;
    if (drawing && event.type === "pointerup") {
      send("move", event, canvas);
      send("release", event, canvas);
    } else if (drawing) {
      send("cancel", event, canvas);
    }
    drawing = false;
    queued = pinch = null;
  }
  addEventListener("pointerup", release);
  addEventListener("pointercancel", release);

  addEventListener("keydown", (event) => {
    const at = event.target;
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    let what = null;
    if (at.matches?.(".viewport")) {
      if (arrow) what = { type: "nudge", dx: arrow[0], dy: arrow[1], shift: event.shiftKey };
      else if (event.key === "Delete" || event.key === "Backspace") what = { type: "remove" };
    }
    if (event.key === "z" && !event.ctrlKey && !event.metaKey && !at.matches?.("input, textarea")) zoomBy("fit");
    if ((event.ctrlKey || event.metaKey) && event.key === "z" && !at.matches?.("input, textarea")) what = { type: "undo" };
    if (!what) return;
    event.preventDefault();
    emitEvent("stage", what);
  });

  // --- Fields: what the server knows is written once nobody types there.
  function fillFields() {
    for (const field of document.querySelectorAll("input[data-value]")) {
      const value = field.dataset.value;
      if (field === document.activeElement || field.dataset.written === value) continue;
      field.value = field.dataset.written = value;
    }
  }
  new MutationObserver(fillFields).observe(document.body, { subtree: true, childList: true, attributeFilter: ["data-value"] });
  addEventListener("focusout", () => setTimeout(fillFields));

  // --- Sliders that only change how the layers look.
  addEventListener("input", (event) => {
    const property = event.target.dataset?.property;
    if (property) document.querySelector(".canvas").style.setProperty(property, event.target.value / 100);
  });

  // --- Texts to copy.
  addEventListener("click", (event) => {
    const button = event.target, source = button.dataset?.copy;
    if (!source) return;
    const element = document.querySelector(`[data-testid="${source}"]`), label = button.textContent;
    if (navigator.clipboard) {
      navigator.clipboard.writeText(element.textContent);
    } else {  // a page from another machine, without encryption
      element.closest("details").open = true;
      getSelection().selectAllChildren(element);
      document.execCommand("copy");
    }
    button.textContent = "copied";
    setTimeout(() => (button.textContent = label), 1500);
  });
})();
