"""Draws the backdrops of scenes to come in a process of its own, while the bench does other things.

A backdrop depends on its description and the camera alone, so that the pictures are the same bytes
whichever process draws them. The process is one scene ahead: it writes a scene's pictures when they
are read, and ends when its pipe is closed.
"""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import IO, cast

from instruments.world import backdrop as backdrops
from instruments.world.backdrop import Backdrop
from instruments.world.optics import CameraModel
from instruments.world.sensor import Image
from instruments.world.shading import Lighting

Scene = tuple[Backdrop, Lighting]
Drawn = tuple[Image, Image]  # light and depth, as of `backdrops.draw`
WORTH_IT = 8  # scenes: for fewer, starting a process takes as long as it saves


class DrawnAhead:
    """Backdrops of ``scenes``, in the order in which they are asked for, by ``cameras``. What is
    not among them, or can't be had from the process, is drawn here.
    """

    def __init__(self, cameras: Sequence[CameraModel], scenes: Sequence[Scene]) -> None:
        self._coming = deque(dict.fromkeys(scenes))
        self._latest: tuple[Scene | None, dict[str, Drawn]] = (None, {})
        self._process = subprocess.Popen(
            [sys.executable, "-m", "instruments.world.ahead"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=Path(__file__).resolve().parents[2],
        )
        self._pictures = cast(IO[bytes], self._process.stdout)
        try:
            with cast(IO[bytes], self._process.stdin) as asked:
                pickle.dump((tuple(cameras), tuple(self._coming)), asked)
        except OSError:  # it ended at once
            self._coming.clear()

    def draw(self, backdrop: Backdrop, lighting: Lighting, camera: CameraModel) -> Drawn:
        """As `backdrops.draw`."""
        drawn = self._taken((backdrop, lighting)).get(camera.name)
        return drawn or backdrops.draw(backdrop, lighting, camera)

    def _taken(self, scene: Scene) -> dict[str, Drawn]:
        """The pictures of a scene by camera; those of the scenes before it are passed over."""
        while scene in self._coming:
            coming = self._coming.popleft()
            try:
                self._latest = coming, pickle.load(self._pictures)  # noqa: S301 - our own process's
            except (EOFError, OSError, pickle.UnpicklingError):
                self._coming.clear()
        return self._latest[1] if self._latest[0] == scene else {}

    def close(self) -> None:
        """End the process."""
        self._coming.clear()
        self._latest = None, {}
        self._pictures.close()
        self._process.kill()
        self._process.wait()


def main() -> None:
    """The process's own part."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the bench, which ends us
    cameras, scenes = pickle.load(sys.stdin.buffer)  # noqa: S301 - the bench's own
    for backdrop, lighting in scenes:
        drawn = {camera.name: backdrops.draw(backdrop, lighting, camera) for camera in cameras}
        pickle.dump(drawn, sys.stdout.buffer, protocol=5)
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
