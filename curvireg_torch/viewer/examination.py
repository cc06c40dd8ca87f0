"""Which sides of the mesh on the page look alike: found in a thread, while nothing else is done."""

import asyncio
import traceback

from ..errors import CurviregError
from ..inspection.facts import mesh_facts
from ..inspection.look_alikes import look_alikes
from ..inspection.report import Inspection
from ..jobs.options import RegisterOptions
from ..mesh import Mesh
from .session import Session, registrar_key


class Examination:
    """Examines the mesh of a session once.

    A search that begins meanwhile waits for the views, which it needs too, and ends the
    examination, which begins again after it.

    Attributes:
        advice: one sentence about the mesh, "" before it is known.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.advice = ""
        self.waits = False
        self._subject: tuple[Mesh, RegisterOptions] | None = None
        self._task: asyncio.Task[None] | None = None

    @property
    def running(self) -> bool:
        """Whether the mesh is being examined."""
        return self._task is not None

    def start_if_due(self, *, searching: bool) -> None:
        """Examine the mesh if it is new, unless there is a search."""
        self.waits = searching
        if self._is_current():
            return
        self.advice = ""
        subject = self._wanted()
        if subject is not None and not self.running and not searching:
            self._subject = subject
            self._task = asyncio.create_task(self._run(*subject))

    def _wanted(self) -> tuple[Mesh, RegisterOptions] | None:
        mesh = self.session.mesh
        return None if mesh is None else (mesh, registrar_key(self.session.request()))

    def _is_current(self) -> bool:
        """Whether the mesh and the options are those that were examined."""
        return self._subject is not None and self._subject == self._wanted()

    async def _run(self, mesh: Mesh, key: RegisterOptions) -> None:
        advice = ""
        try:
            advice = await asyncio.to_thread(self.examined, mesh, key)
        except _StoppedError:
            self._subject = None  # begins again
        except CurviregError as error:
            advice = str(error)
        except Exception:  # a defect must not end the page; the terminal has the traceback
            traceback.print_exc()
        finally:
            self._task = None
        if self._is_current():
            self.advice = advice

    def examined(self, mesh: Mesh, key: RegisterOptions) -> str:
        """The sentence about a mesh, as it is registered with the options."""
        facts = mesh_facts(mesh)
        if facts.is_hopeless:
            return Inspection(facts).in_brief
        registrar = self.session.open_registrar(key, self._report)
        pairs = look_alikes(registrar, self._report)
        return Inspection(facts, pairs).in_brief

    def close(self) -> None:
        """End the examination at its next step."""
        self._subject = None

    def _report(self, stage: str, done: int, total: int) -> None:
        """End the examination if there is another mesh, or if a search needs the processor."""
        is_current = self._is_current()
        if self.waits and stage == "bank" and is_current and not self.session.cancelled:
            self.session.progress = (stage, done, total)
        elif self.waits or not is_current:
            raise _StoppedError("stopped")


class _StoppedError(CurviregError):
    """The examination has ended before its end."""
