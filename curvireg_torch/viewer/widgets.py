"""Plain HTML elements of the page: text, buttons, choosers of files, and parts that fold away; and
what the parts of the page have in common."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

from nicegui import ui

from ..utils.choices import IMAGES, MESHES_AND_BANKS
from .workspace import CALIBRATIONS, Workspace


class Panel(ABC):
    """A part of the page, which shows what changed in a workspace."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace = workspace
        self.session = workspace.session
        self.shown: dict[str, Any] = {}  # what the page shows, to draw only what has changed
        self.lay_out()

    @abstractmethod
    def lay_out(self) -> None:
        """Add the elements to the page."""

    def changed(self, name: str, value: Any) -> bool:
        """Whether something differs from what the page shows, which it does not afterwards."""
        before = self.shown.get(name)
        self.shown[name] = value
        return before is not value


def region(tag: str, classes: str = "", **values: str) -> Any:
    """An element that holds others; attributes are written with ``_`` for ``-``."""
    return ui.element(tag).classes(classes).props(_attributes(values))


def text(tag: str, content: str = "", classes: str = "", **values: str) -> Any:
    """An element with text."""
    return (
        ui.html(escape(content), tag=tag, sanitize=False)
        .classes(classes)
        .props(_attributes(values))
    )


def _attributes(values: Mapping[str, str]) -> str:
    return " ".join(f'{name.replace("_", "-")}="{escape(value)}"' for name, value in values.items())


def fact_line(test_id: str) -> Any:
    """A line, still empty, for what is known."""
    return text("p", "", "facts", data_testid=test_id)


def message_line(part: str) -> Any:
    """A line, still empty, for what :attr:`.Workspace.messages` say about a part of the work."""
    return text("p", "", "message", data_testid=f"message-{part}", role="alert")


def set_text(element: Any, content: str) -> None:
    """Replace the text of an element."""
    element.set_content(escape(content))


def button(
    label: str, on_click: Callable[..., Any], test_id: str, classes: str = "", **values: str
) -> Any:
    """A button; symbols need an ``aria_label``."""
    element = text(
        "button", label, f"button {classes}", type="button", data_testid=test_id, **values
    )
    return element.on("click", lambda: on_click())


def copy_button(label: str, test_id: str) -> None:
    """A button that copies the text of an element; ``page.js`` does it."""
    text("button", label, "button quiet", type="button", data_copy=test_id)


def fold(title: str, test_id: str, *, is_open: bool = False) -> Any:
    """A part that can be folded away; what is built inside is added to it."""
    part = region("details", "fold", data_testid=f"fold-{test_id}").props("open" if is_open else "")
    with part:
        text("summary", title)
    return part


def set_enabled(element: Any, enabled: bool) -> None:
    """Let a button be pressed or not."""
    element.props(remove="disabled") if enabled else element.props("disabled")


def mark(element: Any, name: str, is_on: object) -> None:
    """Give an element a class, or take it."""
    element.classes(**{"add" if is_on else "remove": name})


def set_pressed(element: Any, is_pressed: object) -> None:
    """Show whether a button is the chosen one of several."""
    element.props(f"aria-pressed={'true' if is_pressed else 'false'}")


def file_chooser(label: str, test_id: str) -> None:
    """A button that opens the dialogue for files; ``page.js`` sends them."""
    with region("label", "button file"):
        ui.label(label)
        accept = ",".join((*IMAGES, *MESHES_AND_BANKS, *CALIBRATIONS, ".csv", ".zip"))
        region("input", "hidden-text", type="file", data_testid=test_id, accept=accept).props(
            "multiple"
        )


def field(label: str, test_id: str, on_change: Callable[[str], Any]) -> Any:
    """A field whose text is sent once, by Enter or when it is left."""
    with region("label", "field"):
        text("span", label)
        element = region("input", type="text", data_testid=test_id, autocomplete="off")
    send = "(event) => emit(event.target.value)"
    return element.on("change", lambda event: on_change(str(event.args)), js_handler=send)


def show_value(element: Any, values: Sequence[float]) -> None:
    """Show numbers in a :func:`field`; ``page.js`` writes them once nobody types there."""
    shown = " ".join(repr(value).removesuffix(".0") for value in values)
    element.props(f'data-value="{shown}"')
