"""How a detector's error grows with one quantity: members of `ideal` with one thing changed.

    python docs/examples/sensitivity.py noise fused thesis --scenes 6 --out sensitivity

Writes `noise.csv` and `noise.svg`: the median and the 95th percentile of the ends that were found,
and the share found. Members and their noise are the same at every value.
"""

import argparse
import csv
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

import bench
from bench.testing import Applied
from instruments import Lighting, Paint, Phantom, PlatePose, Situation

MARKS = "os^Dv"


class Quantity(NamedTuple):
    """What is changed, to which values: in the scene, or by a perturbation."""

    label: str
    values: tuple[float, ...]
    scene: Callable[[Situation, float], Situation] = lambda found, _: found
    perturbation: str = ""


def leaning(found: Situation, lean_deg: float) -> Situation:
    """Every teat leans by this, each another way; none stands before another one for long."""
    ways = np.radians([45.0, 135.0, 225.0, 315.0])
    tilts = np.radians(lean_deg) * np.column_stack([np.cos(ways), np.sin(ways)])
    teats = tuple(
        replace(teat, tilt_rad=(float(x), float(y)))
        for teat, (x, y) in zip(found.phantom.teats, tilts, strict=True)
    )
    return replace(found, phantom=Phantom(teats))


def away(found: Situation, mm: float) -> Situation:
    """The phantom moved away from the cameras, and the board with it."""
    board = replace(found.backdrop, board_y_mm=found.backdrop.board_y_mm + max(mm, 0.0))
    moved = found.phantom.moved(PlatePose(y_mm=mm))
    return replace(found, phantom=moved, backdrop=board)


def contrast(found: Situation, share: float) -> Situation:
    """Teats darker than the board by this share of its grey, in light from everywhere."""
    board = replace(found.backdrop, board_albedo=0.5, board_texture=0.0)
    even = Lighting(lamps=(), ambient=2.2)
    return replace(found, backdrop=board, lighting=even, teat_paint=Paint(0.5 * (1.0 - share)))


QUANTITIES = {
    "noise": Quantity("noise (grey levels)", (0, 1, 2, 4, 8, 16), perturbation="noise"),
    "defocus": Quantity("blur disc's radius (px)", (0, 1, 2, 4, 6), perturbation="defocus"),
    "vergence": Quantity("right camera turned (deg)", (0, 0.05, 0.1, 0.2), perturbation="vergence"),
    "lean": Quantity("lean (deg)", (0, 5, 10, 14, 18), leaning),
    "range": Quantity("further away (mm)", (0, 150, 300, 450), away),
    "contrast": Quantity("contrast (share of the board)", (0.06, 0.12, 0.25, 0.5, 0.85), contrast),
}


def measured(
    name: str, detectors: Sequence[str], scenes: int, rig: str = "emulated"
) -> list[dict[str, Any]]:
    """A row for each value and detector."""
    quantity, rows = QUANTITIES[name], []
    for value in quantity.values:
        perturbed = [Applied(quantity.perturbation, value)] if quantity.perturbation else []
        shots = [
            bench.draw(
                quantity.scene(bench.member("ideal", number), value),
                rig=rig,
                perturbations=perturbed,
            )
            for number in range(scenes)
        ]
        for detector in detectors:
            with bench.open_detector(detector) as opened:
                scores = [bench.score(bench.detect(opened, shot), shot) for shot in shots]
            mm = np.array([one for score in scores for one in score.radial_mm])
            visible = sum(score.counts.visible for score in scores)
            row: dict[str, Any] = {"value": value, "detector": detector, "visible": visible}
            row |= {"found": len(mm), "false": sum(score.counts.false for score in scores)}
            row |= {"median_mm": "", "p95_mm": ""}
            if len(mm):
                row |= {
                    "median_mm": np.median(mm).round(4),
                    "p95_mm": np.quantile(mm, 0.95).round(4),
                }
            rows.append(row)
    return rows


def drawn(name: str, rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Errors on a logarithmic scale, and below the share found."""
    figure = Figure((6.0, 5.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    for place, detector in enumerate(dict.fromkeys(row["detector"] for row in rows)):
        look: dict[str, Any] = {"color": f"C{place}", "marker": MARKS[place % len(MARKS)]}
        own = [row for row in rows if row["detector"] == detector]
        found = [row for row in own if row["found"]]
        x = [row["value"] for row in found]
        above.plot(x, [row["median_mm"] for row in found], **look, label=f"{detector}, median")
        p95_mm = [row["p95_mm"] for row in found]
        above.plot(x, p95_mm, **look, linestyle="--", label=f"{detector}, 95th percentile")
        shares = [row["found"] / max(row["visible"], 1) for row in own]
        below.plot([row["value"] for row in own], shares, **look)
    above.set(yscale="log", ylabel="3-D error (mm)")
    above.legend()
    below.set(ylim=(-0.05, 1.05), ylabel="share found", xlabel=QUANTITIES[name].label)
    figure.savefig(path)


def main(
    name: str, detectors: Sequence[str], scenes: int, out: Path, rig: str = "emulated"
) -> list[dict[str, Any]]:
    """Write the table and the figure; gives back the rows."""
    rows = measured(name, detectors, scenes, rig)
    out.mkdir(parents=True, exist_ok=True)
    with (out / f"{name}.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    drawn(name, rows, out / f"{name}.svg")
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("quantity", choices=QUANTITIES)
    parser.add_argument("detectors", nargs="*", default=["fused", "thesis"])
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--out", type=Path, default=Path("sensitivity"))
    given = parser.parse_args()
    with bench.program(__doc__):
        for row in main(given.quantity, given.detectors, given.scenes, given.out):
            print(*row.values())
