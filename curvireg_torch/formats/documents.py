"""Text and array files as plain values: numbers, strings, lists of these, and dicts."""

import json
import re
import tomllib
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from ..errors import InvalidInputError
from ..utils.aliases import Fields
from ..utils.files import foreign_content
from .xml_files import read_xml

EXPECTED = (
    "YAML, XML or JSON of OpenCV, camera_info of ROS, camchain of Kalibr, cameras.txt of COLMAP, "
    "camera.json of BOP, cam_K.txt of 3 x 3 numbers"
)
MAX_DEPTH = 50  # of nested lists and keys
# of an array in an .npz file; larger ones are points of the calibration, and left out
MAX_ARRAY_BYTES = 1 << 16
MAX_ARRAYS = 1000  # of an .npz file
# bounds on TOML, whose time grows with the square of the parts of a key
MAX_TOML_BYTES = 1 << 15
MAX_TOML_PARTS = 100
_TOML = re.compile(r"(?:\s|#[^\n]*+\n)*+(?:\[[A-Za-z_][^\]\n]*+\]|\w++[ \t]*+=)")
_COMMENT = re.compile(r"^[ \t]*+//.*", re.MULTILINE)
_COLMAP_LINE = re.compile(r"^\d+[ \t]+[A-Z][A-Z_]+[ \t]", re.MULTILINE)
_YAML_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_WORDS = {"": None, "~": None, "null": None, "true": True, "false": False}  # of YAML
_COUNTS = (4, 9, 12, 16)  # numbers of fx, fy, cx, cy; of a matrix of 3 x 3, 3 x 4 and 4 x 4


def read_document(file: Path, expected: str = EXPECTED) -> Any:
    """The values in a file; numbers alone are ``{"K": numbers}``, a line of COLMAP is
    ``{"colmap": words}``.

    ``expected`` is what messages say about the kinds of files.

    Raises:
        InvalidInputError: it is damaged, or of no such kind. The message quotes nothing of its
            content.
    """
    data = file.read_bytes()
    foreign = foreign_content(data[:200])
    if foreign is not None:
        raise InvalidInputError(foreign)
    if data.startswith((b"PK\3\4", b"\x93NUMPY")):
        return _arrays(data)
    if file.name == "cameras.bin":
        raise InvalidInputError(
            "a binary file of COLMAP; write it as text: colmap model_converter --output_type TXT"
        )
    text = _text(data, expected)
    start = text.lstrip()[:1]
    if numbers := _numbers_alone(text):
        return {"K": numbers}
    try:
        if _TOML.match(text):
            return _toml(text, expected)
        if start and start in "{[" and file.suffix.lower() not in (".yaml", ".yml"):
            return _json(text)
        if start == "<":
            root = read_xml(data)
            return {root.tag: _element(root)}
    except InvalidInputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(f"cannot be read: {error}; write it again as {expected}") from error
    return _colmap(text) if _COLMAP_LINE.search(text) else _yaml(text, expected)


def _text(data: bytes, expected: str) -> str:
    encoding = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        raise InvalidInputError(
            "not a text file, and pickle is not read; save it as JSON: "
            "json.dump({'camera_matrix': K.tolist(), "
            f"'dist_coeffs': D.tolist()}}, file); expected {expected}"
        ) from error


def _numbers_alone(text: str) -> list[float]:
    """The numbers of a text that holds nothing else, as ``numpy.savetxt`` writes them; [] of
    another text."""
    words = re.sub(r"#.*|[\[\](),;]", " ", text[:5000]).split()
    if len(text) > 5000 or len(words) not in _COUNTS:
        return []
    try:
        return list(map(float, words))
    except ValueError:
        return []


def number(text: str) -> float | str:
    """The number that a word stands for, or the word without its quotes."""
    try:
        return float(text)
    except ValueError:
        return text.strip("\"'")


def _arrays(data: bytes) -> Fields:
    """Small arrays in a file of ``numpy.savez`` or ``numpy.save``, by their names."""
    try:
        if not data.startswith(b"PK"):
            return {"K": _array(data)}
        with zipfile.ZipFile(BytesIO(data)) as archive:
            return {
                member.filename.removesuffix(".npy"): _array(archive.read(member))
                for member in archive.infolist()[:MAX_ARRAYS]
                if member.file_size <= MAX_ARRAY_BYTES and member.filename.endswith(".npy")
            }
    except Exception as error:  # both libraries raise errors of any kind for damaged files
        raise InvalidInputError("a damaged .npz or .npy; save it again with numpy.savez") from error


def _array(data: bytes) -> Any:
    """The values of a file of ``numpy.save``, numbers, or one flag or text; None of others, and of
    objects, which are not loaded."""
    try:
        array = np.load(BytesIO(data), allow_pickle=False)
    except ValueError as error:
        if "allow_pickle" in str(error):
            return None
        raise
    if array.ndim == 0 and array.dtype.kind in "Ub":
        return array.item()
    return array.astype(np.float64).tolist() if array.dtype.kind in "fiu" else None


def _colmap(text: str) -> Fields:
    """The words of each line of ``cameras.txt``, by the camera's number."""
    lines = enumerate((line.partition("#")[0].split() for line in text.splitlines()), start=1)
    return {words[0]: {"colmap": words, "line": count} for count, words in lines if words}


def _json(text: str) -> Any:
    """The values of JSON, in which OpenCV writes comments."""
    try:
        return json.loads(_COMMENT.sub("", text))
    except json.JSONDecodeError as error:
        if error.msg != "Extra data" or error.doc[error.pos] not in "{[":
            raise
        raise InvalidInputError(
            "several documents of JSON, as the lines of results.jsonl; give one line as a file"
        ) from error


def _toml(text: str, expected: str) -> Any:
    parts = max(piece.count(".") for piece in re.split(r"[=,\n]", text))
    if len(text) > MAX_TOML_BYTES or parts > MAX_TOML_PARTS:
        raise InvalidInputError("TOML that is too large for a calibration; write it as JSON")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:  # whose words quote the file
        raise InvalidInputError(f"neither TOML nor {expected}; write it again") from error


def _element(element: ElementTree.Element) -> Any:
    """The numbers or words of an element, or elements by their tags; attributes count as
    elements."""
    if not len(element) and (words := (element.text or "").split()):
        numbers = [number(word) for word in words]
        return numbers[0] if len(numbers) == 1 else numbers
    values: Fields = {name: number(text) for name, text in element.attrib.items()}
    for child in element:
        inside = _element(child)
        if several := values.get(child.tag):
            inside = [*(several if isinstance(several, list) else [several]), inside]
        values[child.tag] = inside
    return values or []


def _yaml(text: str, expected: str) -> Any:
    """The first document with content. Tags say nothing here."""
    text = re.sub(r"(?m)^%.*", "", text)  # OpenCV's "%YAML:1.0" is none of YAML's directives
    try:
        documents = (_value(node, set(), 0) for node in yaml.compose_all(text, _YAML_LOADER))
        return next((value for value in documents if value is not None), None)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = "" if mark is None else f"line {mark.line + 1}: "
        raise InvalidInputError(f"{place}expected 'key: value'; expected {expected}") from error


def _value(node: Any, known: set[int], depth: int) -> Any:
    """The value of a node of YAML. A node that is met again is an alias, and refused: those can
    blow a file up."""
    if depth > MAX_DEPTH:
        raise InvalidInputError("nested too deeply; write it again")
    if id(node) in known:
        raise InvalidInputError("has aliases (*name), which are not read; write it without them")
    known.add(id(node))
    if isinstance(node, yaml.ScalarNode):
        is_quoted = node.style in ("'", '"')
        return node.value if is_quoted else _WORDS.get(node.value.lower(), number(node.value))
    if isinstance(node, yaml.SequenceNode):
        return [_value(item, known, depth + 1) for item in node.value]
    if not all(isinstance(key, yaml.ScalarNode) for key, _ in node.value):
        raise InvalidInputError("a list or mapping where a key is expected; write it again")
    return {str(key.value): _value(item, known, depth + 1) for key, item in node.value}
