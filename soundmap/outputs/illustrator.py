"""Who draws the pictures: this process, or one beside it while the log is being read.

What draws takes half a second to load, and a picture a tenth to draw. So where a core is free,
another process gets ready at once and draws what it is told to, as soon as that is known. It
writes no file and gives back the pictures alone; whatever befalls it, this process can draw them.
It ends with the pipe that it hears from, so it does not outlive this one.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from soundmap.cores import usable_cores
from soundmap.outputs.picture_format import PictureFormat
from soundmap.outputs.pictures import Picture, Pictures, drawn

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Illustrator:
    """Draws pictures in one format.

    Parameters
    ----------
    form : PictureFormat
    elsewhere : callable, optional
        Has a picture drawn by another process; without it, all are drawn here.
    """

    def __init__(
        self,
        form: PictureFormat = PictureFormat.PNG,
        elsewhere: Callable[[Callable[[], Figure]], Future[Picture]] | None = None,
    ) -> None:
        self.form = form
        self._elsewhere = elsewhere
        self._begun: dict[str, Future[Picture]] = {}

    def begin(self, pictures: Pictures) -> None:
        """Have pictures drawn while this process goes on, if another can draw them."""
        if self._elsewhere is not None:
            self._begun |= {name: self._elsewhere(draw) for name, draw in pictures.items()}

    def write(self, pictures: Pictures, folder: Path) -> dict[str, bytes]:
        """Write pictures as files, unless none are wanted.

        Returns
        -------
        dict
            What a browser can show of each, by name.
        """
        if self.form == PictureFormat.NONE:
            return {}
        self.begin({name: draw for name, draw in pictures.items() if name not in self._begun})
        shown = {}
        for name, draw in pictures.items():
            picture = self._finished(name) or drawn(draw, self.form)
            (folder / f"{name}.{self.form}").write_bytes(picture.content)
            shown[name] = picture.shown
        return shown

    def _finished(self, name: str) -> Picture | None:
        """A picture of the other process; None if it has failed, or there is none."""
        begun = self._begun.pop(name, None)
        try:
            return None if begun is None else begun.result()
        except Exception:  # whatever it was: if it is no fault of that process, it comes up here
            return None


@contextmanager
def illustrator(form: PictureFormat) -> Iterator[Illustrator]:
    """Who draws pictures; open it before the long work, so that they cost it little time."""
    process = _started() if form != PictureFormat.NONE and usable_cores() > 1 else None
    if process is None or process.stdin is None or process.stdout is None:
        yield Illustrator(form)
        return
    requests, replies = process.stdin, process.stdout
    with ThreadPoolExecutor(1) as line:  # one request at a time
        try:
            yield Illustrator(form, lambda draw: line.submit(_asked, draw, form, requests, replies))
        finally:
            process.kill()
            line.shutdown(cancel_futures=True)
            with suppress(OSError):
                requests.close()
            replies.close()
            process.wait()


def _started() -> subprocess.Popen[bytes] | None:
    """The other process, deaf to a terminal's Ctrl-C; None if there cannot be one."""
    program = (
        f"import sys; sys.path[:] = {sys.path!r}; "
        "from soundmap.outputs.illustrator import serve; serve()"
    )
    try:
        return subprocess.Popen(  # noqa: S603 (this very Python)
            [sys.executable, "-c", program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError:
        return None


def _asked(
    draw: Callable[[], Figure], form: PictureFormat, requests: IO[bytes], replies: IO[bytes]
) -> Picture:
    pickle.dump((draw, form), requests)
    requests.flush()
    picture: Picture = pickle.load(replies)  # noqa: S301 (of a process of ours)
    return picture


def serve() -> None:
    """Draw what is asked for until nobody asks any more; this runs in the other process."""
    from soundmap.outputs import figures, time_figures  # noqa: F401  (ready before it is needed)

    requests, replies = sys.stdin.buffer, sys.stdout.buffer
    sys.stdout = sys.stderr  # whatever a library prints is no picture
    while (request := _next(requests)) is not None:
        pickle.dump(drawn(*request), replies)
        replies.flush()


def _next(requests: IO[bytes]) -> tuple[Any, PictureFormat] | None:
    try:
        request: tuple[Any, PictureFormat] = pickle.load(requests)  # noqa: S301
    except EOFError:
        return None
    return request
