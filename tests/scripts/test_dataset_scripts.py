"""Scripts of ``datasets/``, with generated trees and a local server."""

import hashlib
import importlib.util
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import ClassVar

import pytest

from curvireg_torch.data import Pascal3DPlus
from tests._support import miniature
from tests._support.miniature import pascal_object, write_bop, write_pascal3d, write_web
from tests._support.scripts import ROOT


def load(name):
    spec = importlib.util.spec_from_file_location(f"datasets_{name}", ROOT / "datasets" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["download", "verify", "convert_objectnet3d"])
def test_help(name, capsys):
    with pytest.raises(SystemExit, match="0"):
        load(name).main(["--help"])
    output = capsys.readouterr().out
    assert "Exit code" in output or "manifest" in output


def test_verify_defective_trees(tmp_path, capsys):
    for kind, write in (("pascal3d", write_pascal3d), ("bop", write_bop), ("web", write_web)):
        write(tmp_path / kind)
        assert load("verify").main([kind, str(tmp_path / kind)]) == 1
    out = capsys.readouterr().out
    assert "5 objects in 4 photographs" in out
    assert "left out, other_class: 3" in out
    assert "defect, missing_image: 1\n  car_pascal/2008_000009" in out


def test_verify_tree_without_defects_and_with_a_truncated_photograph(tmp_path, capsys):
    write_pascal3d(tmp_path)
    arguments = ["pascal3d", str(tmp_path), "--categories", "sofa", "--images"]
    assert load("verify").main(arguments) == 0
    path = tmp_path / "Images" / "sofa_pascal" / "2008_000002.jpg"
    path.write_bytes(path.read_bytes()[:300])
    assert load("verify").main(arguments) == 1
    assert "defect, corrupt_image: 1" in capsys.readouterr().out


def test_verify_unusable_tree(tmp_path, capsys):
    assert load("verify").main(["bop", str(tmp_path)]) == 2
    assert "datasets/bop/README.md" in capsys.readouterr().err


@pytest.mark.parametrize("cad", ["CAD/off", "CAD"])
def test_convert_objectnet3d(tmp_path, cad, capsys):
    convert = load("convert_objectnet3d").main
    root, out = tmp_path / "ObjectNet3D", tmp_path / "out"
    arguments = [str(root), str(out), "--splits", "val"]
    car, ashtray = pascal_object("car", viewpoint={"viewport": 2000.0}), pascal_object("ashtray")
    for name, objects in (("n1_1", [car, ashtray]), ("n1_2", [ashtray]), ("n1_3", [])):
        miniature.write_record(root / "Annotations" / f"{name}.mat", objects)
        miniature.write_image(root / "Images" / f"{name}.jpg")
        (root / "Images" / f"{name}.jpg").rename(root / "Images" / f"{name}.JPEG")
    for category in ("car", "ashtray"):
        miniature.write_mesh(root / cad / category / "01.off")
    (root / "Image_sets").mkdir()
    (root / "Image_sets" / "val.txt").write_text("n1_1\nn1_2\nn1_3\n")
    assert convert(arguments) == 0
    assert convert(arguments) == 0, "running it again changes nothing"
    dataset = Pascal3DPlus(out, part="imagenet")
    found = [(s["category"], s["image_id"]) for s in map(dataset.annotation, range(len(dataset)))]
    assert found == [("ashtray", "n1_1"), ("ashtray", "n1_2"), ("car", "n1_1")]
    assert dataset[2]["camera_matrix"][0, 0] == 2000
    (root / "Image_sets" / "val.txt").write_text("n1_1\nn1_9\n../n1_1\n")
    assert convert(arguments) == 1
    assert "2 missing_annotation, 1 placed" in capsys.readouterr().out
    assert convert([str(tmp_path / "nothing"), str(out)]) == 2


CONTENT = bytes(range(256)) * 40


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.0"
    content, cut, tag = CONTENT, None, '"v1"'
    ranges: ClassVar[list[str | None]] = []

    def do_GET(self):
        cls = type(self)
        begin, requested = 0, self.headers.get("Range")
        cls.ranges.append(requested)
        if requested and self.headers.get("If-Range") == cls.tag:
            begin = int(requested.removeprefix("bytes=").removesuffix("-"))
            if begin >= len(cls.content):
                self.send_error(416)
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {begin}-{len(cls.content) - 1}/{len(cls.content)}")
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(len(cls.content) - begin))
        self.send_header("ETag", cls.tag)
        self.end_headers()
        self.wfile.write(cls.content[begin : cls.cut])

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    handler = type("OwnHandler", (Handler,), {"ranges": []})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as http:
        thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield handler, f"http://127.0.0.1:{http.server_address[1]}/set%20a.zip"
        http.shutdown()
        thread.join()


@pytest.fixture
def download(tmp_path, server):
    """Run the script with ``words``; returns its exit code."""
    return lambda *words: load("download").main([server[1], "--out", str(tmp_path / "new"), *words])


def test_download_records_then_verifies(tmp_path, server, download, capsys):
    handler, url = server
    assert download() == 0
    assert (tmp_path / "new" / "set a.zip").read_bytes() == CONTENT
    assert json.loads((tmp_path / "new" / "manifest.json").read_text()) == {
        "set a.zip": {"url": url, "size": len(CONTENT), "sha256": hashlib.sha256(CONTENT).hexdigest()}
    }
    assert download() == 0
    assert len(handler.ranges) == 1, "the second run downloads nothing"
    assert capsys.readouterr().out.splitlines() == ["set a.zip: downloaded", "set a.zip: verified"]
    (tmp_path / "new" / "set a.zip").write_bytes(b"changed")
    assert download() == 1
    assert "delete the file" in capsys.readouterr().err
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["manifest.json", "set a.zip"]


@pytest.mark.parametrize(("tag", "content"), [('"v1"', CONTENT), ('"v2"', CONTENT[::-1])])
def test_download_resumes_unless_the_file_changed(tmp_path, server, download, capsys, tag, content):
    handler = server[0]
    handler.cut = 5000
    assert download() == 1
    assert "run again" in capsys.readouterr().err
    handler.cut, handler.tag, handler.content = None, tag, content
    assert download() == 0
    assert handler.ranges == [None, "bytes=5000-"]
    assert (tmp_path / "new" / "set a.zip").read_bytes() == content


def test_download_completes_a_finished_part(tmp_path, server, download):
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "set a.zip.part").write_bytes(CONTENT)
    (tmp_path / "new" / "set a.zip.part.validator").write_text(server[0].tag)
    assert download() == 0
    assert (tmp_path / "new" / "set a.zip").read_bytes() == CONTENT


def test_download_with_checksum(tmp_path, download, capsys):
    assert download("--sha256", "0" * 64) == 1
    assert "discarded" in capsys.readouterr().err
    assert list((tmp_path / "new").iterdir()) == []
    assert download("--sha256", hashlib.sha256(CONTENT).hexdigest().upper()) == 0


@pytest.mark.parametrize("url", ["file:///etc/hostname", "https://host/", "plain"])
def test_download_refuses_other_addresses(tmp_path, url, capsys):
    assert load("download").main([url, "--out", str(tmp_path)]) == 1
    assert "expected an http" in capsys.readouterr().err
