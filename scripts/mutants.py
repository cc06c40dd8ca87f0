"""Where a source file can be changed in one small place: the mutants of ``mutate.py``.

Comparisons, operators, ``and``/``or``, signs and ``not``, numbers (also of indices and defaults), switches, functions
with a twin (``min``, ``max``), neighbouring arguments, dropped statements, conditions that never hold. Not mutated, by
rule: docstrings and other texts, what a ``raise`` says, annotations, decorators, ``zip(strict=)``, ``stacklevel=``,
sizes of chunks, guards smaller than 1e-5.
"""

import ast
import hashlib
import re
from collections import Counter
from dataclasses import dataclass

__all__ = ["Mutant", "mutants_of"]

COMPARE = {"<": ("<=", ">="), "<=": ("<", ">"), ">": (">=", "<="), ">=": (">", "<"), "==": ("!=",), "!=": ("==",)}
COMPARE |= {"is": ("is not",), "is not": ("is",), "in": ("not in",), "not in": ("in",)}
ARITHMETIC = {"+": "-", "-": "+", "*": "/", "/": "*", "//": "*", "%": "*", "**": "*", "&": "|", "|": "&"}
ARITHMETIC |= {"<<": ">>", ">>": "<<"}
TWINS = ("min max", "amin amax", "argmin argmax", "minimum maximum", "sin cos", "floor ceil", "any all")
TWINS += ("zeros_like ones_like", "zeros ones", "deg2rad rad2deg", "radians degrees", "cummin cummax", "asin acos")
NAMES = {a: b for pair in TWINS for a, b in (pair.split(), pair.split()[::-1])}
SIZES = re.compile(r"_?(CHUNK|BLOCK|BATCH|WORKERS)\w*$")
UNTOLD_KEYWORDS = {"strict", "stacklevel"}
SMALLEST = 1e-5


@dataclass(frozen=True)
class Mutant:
    """Bytes ``start:end`` of a file replaced; ``key`` names it as long as the statement around it stays as it is."""

    path: str
    line: int
    kind: str
    start: int
    end: int
    text: str
    key: str = ""

    def apply(self, source: bytes) -> bytes:
        return source[: self.start] + self.text.encode() + source[self.end :]

    def diff(self, source: bytes) -> tuple[str, str]:
        """The line before and after."""
        begin = source.rfind(b"\n", 0, self.start) + 1
        stop = source.find(b"\n", self.end)
        changed = source[begin : self.start] + self.text.encode() + source[self.end : stop]
        return source[begin:stop].decode().strip(), changed.decode().strip()


class Finder(ast.NodeVisitor):
    """Collects (line, kind, start, end, text) of every mutant of a file."""

    def __init__(self, source: bytes) -> None:
        self.source = source
        self.starts = [0, *(i + 1 for i, b in enumerate(source) if b == 10)]
        self.found: list[tuple[int, str, int, int, str]] = []

    def span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self.starts[node.lineno - 1] + node.col_offset, self.starts[node.end_lineno - 1] + node.end_col_offset

    def code(self, node: ast.expr | ast.stmt) -> str:
        start, end = self.span(node)
        return self.source[start:end].decode()

    def add(self, node: ast.expr | ast.stmt, kind: str, text: str, start: int = -1, end: int = -1) -> None:
        begin, stop = self.span(node)
        self.found.append((node.lineno, kind, begin if start < 0 else start, stop if end < 0 else end, text))

    def between(self, left: ast.expr, right: ast.expr, kind: str, changes: dict[str, tuple[str, ...]]) -> None:
        """Another operator between two operands."""
        start, end = self.span(left)[1], self.span(right)[0]
        gap = re.sub(rb"#[^\n]*", lambda m: b" " * len(m[0]), self.source[start:end]).decode()
        found = re.search(r"not\s+in|is\s+not|\bis\b|\bin\b|\band\b|\bor\b|//|\*\*|<<|>>|[<>=!]=|[-+*/%&|<>@]", gap)
        if found:
            for text in changes.get(" ".join(found[0].split()), ()):
                self.add(left, kind, text, start + found.start(), start + found.end())

    def visit_Compare(self, node: ast.Compare) -> None:
        for left, right in zip([node.left, *node.comparators], node.comparators, strict=False):
            self.between(left, right, "comparison", COMPARE)
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        if isinstance(node.op, ast.MatMult):
            self.add(node, "operands", f"({self.code(node.right)}) @ ({self.code(node.left)})")
        else:
            self.between(node.left, node.right, "arithmetic", {a: (b,) for a, b in ARITHMETIC.items()})
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        for left, right in zip(node.values, node.values[1:], strict=False):
            self.between(left, right, "and/or", {"and": ("or",), "or": ("and",)})
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if not isinstance(node.op, ast.UAdd):
            self.add(node, "dropped sign", f"({self.code(node.operand)})")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self.add(node, "switch", repr(not value))
        elif isinstance(value, int):
            self.add(node, "number", repr(value + 1))
            if value > 0:
                self.add(node, "number", repr(value - 1))
        elif isinstance(value, float) and (value == 0 or abs(value) >= SMALLEST):
            self.add(node, "number", repr(2.0 * value if value else 1.0))
            if value:
                self.add(node, "number", repr(0.8 * value))

    def visit_Name(self, node: ast.Name) -> None:
        if isinstance(node.ctx, ast.Load) and node.id in NAMES:
            self.add(node, "function", NAMES[node.id])

    def visit_Attribute(self, node: ast.Attribute) -> None:
        if node.attr in NAMES:
            end = self.span(node)[1]
            self.add(node, "function", NAMES[node.attr], end - len(node.attr), end)
        self.visit(node.value)

    def visit_Call(self, node: ast.Call) -> None:
        for a, b in zip(node.args, node.args[1:], strict=False):
            alike = all(isinstance(x, (ast.Name, ast.Attribute)) for x in (a, b)) or all(
                isinstance(x, ast.Constant) and isinstance(x.value, (int, float)) for x in (a, b)
            )
            if alike and self.code(a) != self.code(b) and self.code(node.func) != "isinstance":
                gap = self.source[self.span(a)[1] : self.span(b)[0]].decode()
                swapped = self.code(b) + gap + self.code(a)
                self.add(a, "arguments", swapped, self.span(a)[0], self.span(b)[1])
        self.visit(node.func)
        for argument in (*node.args, *(k for k in node.keywords if k.arg not in UNTOLD_KEYWORDS)):
            self.visit(argument)

    def visit_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):
            self.add(node, "dropped statement", "pass")
            self.visit(node.value)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self.add(node, "dropped statement", "pass")
        self.visit(node.value)

    def visit_Continue(self, node: ast.Continue) -> None:
        self.add(node, "dropped statement", "pass")

    visit_Break = visit_Continue  # type: ignore[assignment]  # noqa: N815

    def visit_If(self, node: ast.If) -> None:
        if not self.code(node.test).endswith("TYPE_CHECKING"):
            self.add(node.test, "never", "False")
        self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        if not any(isinstance(t, ast.Name) and SIZES.match(t.id) for t in node.targets):
            self.visit(node.value)
            for target in node.targets:
                self.visit(target)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for part in (*node.args.defaults, *(d for d in node.args.kw_defaults if d), *node.body):
            self.visit(part)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for part in node.body:
            self.visit(part)

    def visit_Raise(self, node: ast.Raise) -> None:
        """What an error says is no mutant."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Texts are no mutants."""


def mutants_of(path: str, source: bytes) -> list[Mutant]:
    """Every mutant of a file that compiles."""
    tree = ast.parse(source)
    finder = Finder(source)
    finder.visit(tree)
    spans = [(s.lineno, s.end_lineno or 0, ast.dump(s)) for s in tree.body]
    found, seen = [], Counter[str]()
    for line, kind, start, end, text in finder.found:
        mutant = Mutant(path, line, kind, start, end, text)
        try:
            compile(mutant.apply(source), path, "exec")
        except SyntaxError:
            continue
        around = next(code for first, last, code in spans if first <= line <= last)
        label = f"{path} {kind}: {' -> '.join(mutant.diff(source))}"
        seen[label] += 1
        digest = hashlib.sha1(around.encode()).hexdigest()[:8]
        found.append(Mutant(path, line, kind, start, end, text, f"{label} #{seen[label]} in {digest}"))
    return found
