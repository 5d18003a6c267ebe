"""The cameras' live pictures on a page in the browser, to place cameras and set lenses by.

Each picture has a cross at its middle, and what its figures say: blur, brightest grey level, and
how much is white.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import cv2

from instruments.camera.cameras import KNOWN
from instruments.camera.frame import FrameError, FrameFault, FrameSet, Grey
from instruments.camera.quality import level_dn, saturated_share
from instruments.camera.stream import StreamServer
from instruments.clock import RealClock

FIGURE = '<figure><figcaption>{0}</figcaption><img src="{1}.mjpg" alt="{0} camera, live"></figure>'
DARK, BRIGHT, FONT = 0, 255, cv2.FONT_HERSHEY_SIMPLEX


class LivePage:
    """What the cameras saw last, at ``url``."""

    def __init__(self, cameras: Sequence[str], clock: RealClock, every_s: float) -> None:
        self.clock = clock
        self._last: FrameSet | None = None
        # one camera without a place in a rig is shown in the first one's
        self._places = dict(zip(cameras, cameras if len(cameras) > 1 else KNOWN, strict=False))
        rows = [FIGURE.format(name, place) for name, place in self._places.items()]
        text = Path(__file__).with_suffix(".html").read_text(encoding="utf-8")
        page = text.format(figures="".join(rows))
        self._server = StreamServer(self, clock, fps=1.0 / every_s, page=lambda: page)
        self.url = self._server.page_url

    def capture(self) -> FrameSet:
        """The pictures shown last. Raises FrameError before there are any."""
        if self._last is None:
            raise FrameError(FrameFault.DROPPED, KNOWN[0], "cameras", "no picture yet")
        return self._last

    def show(self, pictures: Mapping[str, Grey], lines: Sequence[str]) -> None:
        """Each picture (h, w) uint8 with its line of figures, from now on."""
        drawn = {
            self._places[name]: annotated(picture, line)
            for (name, picture), line in zip(pictures.items(), lines, strict=True)
        }
        left = drawn[KNOWN[0]]
        self._last = FrameSet(left, drawn.get("right", left), drawn.get("thermal"))

    def close(self) -> None:
        """End the streams; may be called again."""
        self._server.close()


@contextmanager
def live_page(pictures: Mapping[str, Grey], every_s: float) -> Iterator[LivePage]:
    """Serves the cameras of ``pictures`` on this machine until left. Raises OSError."""
    with closing(RealClock()) as clock, closing(LivePage([*pictures], clock, every_s)) as page:
        yield page


def annotated(picture: Grey, line: str) -> Grey:
    """A copy with a cross at the middle, and two lines of figures at the top."""
    drawn = picture.copy()
    height, width = drawn.shape
    scale = width / 1000.0
    figures = (
        f"brightest {level_dn(picture, 0.995):.0f}, white {100.0 * saturated_share(picture):.1f} %"
    )
    cv2.drawMarker(drawn, (width // 2, height // 2), BRIGHT, cv2.MARKER_CROSS, width // 8, 3)
    cv2.drawMarker(drawn, (width // 2, height // 2), DARK, cv2.MARKER_CROSS, width // 8, 1)
    for row, text in enumerate((f"blur: {line.partition(' #')[0]}", figures), start=1):
        place = (int(16 * scale), int(40 * scale * row))
        for grey, thick in ((DARK, 6), (BRIGHT, 2)):
            thick_px = max(1, round(thick * scale))
            cv2.putText(drawn, text, place, FONT, scale, grey, thick_px, cv2.LINE_AA)
    return drawn
