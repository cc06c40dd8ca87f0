"""Download dataset archives, resume interrupted downloads and verify existing files.

    python datasets/download.py URL [URL ...] --out FOLDER

FOLDER/manifest.json records URL, size and SHA-256 of every complete file; later runs verify the
file against this record instead of downloading it again. --sha256 gives a known checksum (one URL
only). Interrupted http(s) downloads are resumed if the server still has the same file; ftp
downloads start again. Archives are not unpacked: use `python -m zipfile -e ARCHIVE.zip FOLDER`.
"""

import argparse
import hashlib
import json
import os
import sys
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

CHUNK = 1 << 20


class DownloadError(Exception):
    """A download failed; the message says what to do."""


def sha256_of(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def load_manifest(folder: Path) -> dict[str, dict[str, Any]]:
    path = folder / "manifest.json"
    manifest: dict[str, dict[str, Any]] = json.loads(path.read_text()) if path.is_file() else {}
    return manifest


def save_manifest(folder: Path, manifest: dict[str, dict[str, Any]]) -> None:
    temporary = folder / "manifest.json.tmp"
    temporary.write_text(json.dumps(manifest, indent=2, sort_keys=True) + "\n")
    os.replace(temporary, folder / "manifest.json")


def file_name(url: str) -> str:
    parts = urllib.parse.urlsplit(url)
    name = Path(urllib.parse.unquote(parts.path)).name
    if parts.scheme not in ("http", "https", "ftp") or not name:
        raise DownloadError(
            f"{url}: expected an http, https or ftp address that ends in a file name"
        )
    return name


def fetch(url: str, part: Path, validator: str | None, timeout: float) -> int | None:
    """Append the missing bytes to ``part``; returns the full size if the server reports it."""
    present = part.stat().st_size if part.is_file() else 0
    request = urllib.request.Request(url)
    if present and validator and url.startswith("http"):
        request.add_header("Range", f"bytes={present}-")
        request.add_header("If-Range", validator)
    try:
        response = urllib.request.urlopen(request, timeout=timeout)
    except urllib.error.HTTPError as error:
        if error.code == 416:  # nothing is left, or the file has changed: start again
            part.unlink(missing_ok=True)
            return fetch(url, part, None, timeout)
        raise
    with response:
        headers = response.headers
        resumed = getattr(response, "status", None) == 206
        if resumed and not headers.get("Content-Range", "").startswith(f"bytes {present}-"):
            raise DownloadError(
                f"{url}: the server sent another range than requested; delete {part} and run again"
            )
        length = headers.get("Content-Length")
        total = None if length is None else int(length) + (present if resumed else 0)
        tag = headers.get("ETag") or "W/"
        new_validator = headers.get("Last-Modified", "") if tag.startswith("W/") else tag
        part.with_suffix(part.suffix + ".validator").write_text(new_validator)
        with open(part, "ab" if resumed else "wb") as file:
            while chunk := response.read(CHUNK):
                file.write(chunk)
                message = f"\r{part.stem}: {file.tell() / 1e6:.1f} MB of {(total or 0) / 1e6:.1f}"
                print(message, end="", file=sys.stderr)
        print(file=sys.stderr)
    return total


def download(url: str, folder: Path, sha256: str | None = None, timeout: float = 60.0) -> str:
    """Download or verify one file; returns a message."""
    name = file_name(url)
    path = folder / name
    part = folder / f"{name}.part"
    manifest = load_manifest(folder)
    known = manifest.get(name)
    expected = sha256 or (known["sha256"] if known else None)
    if path.is_file():
        found = sha256_of(path)
        if expected is not None and found != expected:
            raise DownloadError(
                f"{path}: checksum {found}, expected {expected}; delete the file and run again"
            )
        message = (
            "recorded, not verified: no checksum was known" if expected is None else "verified"
        )
    else:
        record = part.with_suffix(part.suffix + ".validator")
        validator = record.read_text() if record.is_file() else None
        total = fetch(url, part, validator, timeout)
        size = part.stat().st_size
        if total is not None and size != total:
            raise DownloadError(f"{url}: got {size} of {total} bytes; run again to continue")
        found = sha256_of(part)
        if expected is not None and found != expected:
            part.unlink()
            record.unlink(missing_ok=True)
            raise DownloadError(
                f"{url}: checksum {found}, expected {expected}; the file was discarded"
            )
        os.replace(part, path)
        record.unlink(missing_ok=True)
        message = "downloaded" if expected is None else "downloaded and verified"
    manifest[name] = {"url": url, "size": path.stat().st_size, "sha256": found}
    save_manifest(folder, manifest)
    return f"{name}: {message}"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "urls",
        nargs="+",
        metavar="URL",
        help="address of an archive; see the README of the dataset",
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="folder for the files and manifest.json"
    )
    parser.add_argument("--sha256", help="checksum that the file must have (one URL only)")
    parser.add_argument(
        "--timeout", type=float, default=60.0, help="seconds without a response before giving up"
    )
    options = parser.parse_args(arguments)
    if options.sha256 and len(options.urls) > 1:
        parser.error("--sha256 expects a single URL")
    options.out.mkdir(parents=True, exist_ok=True)
    failed = 0
    for url in options.urls:
        try:
            print(
                download(
                    url, options.out, options.sha256 and options.sha256.lower(), options.timeout
                )
            )
        except (DownloadError, OSError, ValueError) as error:
            print(f"{url}: {error}" if url not in str(error) else error, file=sys.stderr)
            failed += 1
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
