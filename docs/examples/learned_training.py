"""Trains both networks of the learned detector beside this file, and writes them as ONNX.

    teatbench scene record --seeds 20 --out train --coco train.json
    python3 mine_train.py train train.json

Six minutes on one processor. The detector mine.py beside it says how pictures are prepared. What
the networks were trained on is written into mine.find.onnx.
Needs: pip install jax onnx onnxruntime numpy opencv-python-headless
"""

import json
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

STEM = Path(__file__).resolve().with_name(Path(__file__).stem.removesuffix("_train"))
detector = import_module(STEM.name)

# of each layer: kernel, channels in and out, step, dilation; between two layers what is below 0 is cut off
FIND = (
    *((3, 2, 12, 1, 1), (3, 12, 12, 1, 2), (3, 12, 16, 1, 4)),
    *((3, 16, 16, 1, 8), (3, 16, 16, 1, 1), (1, 16, 1, 1, 1)),
)
PLACE = (5, 1, 12, 2, 1), (3, 12, 16, 1, 1), (3, 16, 16, 1, 2), (3, 16, 16, 1, 4), (1, 16, 1, 1, 1)
# parts of a picture that `find` learns from; the width of a peak
PART, SPREAD_PX, UNSURE_PX = 80, 1.2, 5
GRID = np.stack(np.meshgrid(*[2.0 * np.arange(32)] * 2), axis=-1).reshape(-1, 2).astype(np.float32)


def new(layers: Any, rng: Any) -> Any:
    """Weights and offsets of the layers."""
    made = []
    for k, a, b, _, _ in layers:
        weights = rng.normal(0.0, np.sqrt(2.0 / (k * k * a)), (b, a, k, k))
        made.append((weights.astype(np.float32), np.zeros(b, np.float32)))
    return made


def run(layers: Any, weights: Any, x: Any) -> Any:
    """The network without its last step."""
    for number, ((k, _, _, step, wide), (w, b)) in enumerate(zip(layers, weights, strict=True)):
        pad, dilation = [(wide * (k // 2),) * 2] * 2, (wide, wide)
        x = jax.lax.conv_general_dilated(x, w, (step, step), pad, rhs_dilation=dilation)
        x = x + b[:, None, None]
        x = jax.nn.relu(x) if number < len(layers) - 1 else x
    return x


def placed(weights: Any, x: Any) -> Any:
    """(n, 2): the mean of the map as a distribution."""
    heat = jax.nn.softmax(run(PLACE, weights, x).reshape(len(x), -1), axis=1)
    return heat @ GRID


def find_loss(weights: Any, x: Any, heat: Any, counts: Any) -> Any:
    """CenterNet's focal loss (Zhou 2019, equation 1), where a pixel counts."""
    z = run(FIND, weights, x)[:, 0]
    p = jax.nn.sigmoid(z)
    at_end = heat > 0.99
    hit = -jax.nn.log_sigmoid(z) * (1 - p) ** 2
    miss = -jax.nn.log_sigmoid(-z) * p**2 * (1 - heat) ** 4
    return jnp.sum(jnp.where(at_end, hit, miss) * counts) / (1.0 + jnp.sum(at_end * counts))


def place_loss(weights: Any, x: Any, end_px: Any, _: Any) -> Any:
    off = placed(weights, x) - end_px
    return jnp.mean(jnp.sum(jnp.sqrt(off * off + 0.1), axis=1))


def trained(loss: Any, weights: Any, batch: Any, steps: int, rate: float) -> Any:
    """The weights after so many steps of Adam (Kingma 2015), its rate falling to nothing."""

    def step(weights: Any, m: Any, v: Any, t: Any, *given: Any) -> Any:
        value, slope = jax.value_and_grad(loss)(weights, *given)
        m = jax.tree.map(lambda a, g: 0.9 * a + 0.1 * g, m, slope)
        v = jax.tree.map(lambda a, g: 0.999 * a + 0.001 * g * g, v, slope)
        now = rate * 0.5 * (1.0 + jnp.cos(jnp.pi * t / steps))

        def moved(w: Any, a: Any, b: Any) -> Any:
            return w - now * (a / (1 - 0.9**t)) / (jnp.sqrt(b / (1 - 0.999**t)) + 1e-8)

        return jax.tree.map(moved, weights, m, v), m, v, value

    fast, mean = jax.jit(step), 0.0
    m = v = jax.tree.map(jnp.zeros_like, weights)
    for number in range(1, steps + 1):
        weights, m, v, value = fast(weights, m, v, float(number), *batch())
        mean += (float(value) - mean) / min(number, 100)
        if number % 200 == 0:
            print(f"  step {number} of {steps}: {mean:.4f}", flush=True)
    return jax.tree.map(np.asarray, weights)


class Pictures:
    """The optical pictures of a recording, as the networks see them, with their ends."""

    def __init__(self, recording: Path, coco: Path, rng: Any) -> None:
        self.table, self._rng = json.loads(coco.read_text(encoding="utf-8")), rng
        rig = detector.Rig(str(recording / "calibration.toml"))
        ends: dict[int, list[Any]] = {}
        for one in self.table["annotations"]:
            ends.setdefault(one["image_id"], []).append(one["keypoints"][:3])
        self.grey, self.small, self.heat, self.counts, self.ends = [], [], [], [], []
        for image in self.table["images"]:
            if image["camera"] == "thermal":
                continue
            path = recording / image["file_name"]
            grey = detector.read(path)
            kelvin = detector.read(path.with_name("thermal_radiometric.png")) / 100.0
            small = detector.seen_small(grey, rig, image["camera"], kelvin)
            known = np.array([one for one in ends.get(image["id"], []) if one[2]]).reshape(-1, 3)
            heat, counts = (make(small.shape[1:], np.float32) for make in (np.zeros, np.ones))
            for *end, flag in known:
                at = np.rint((np.array(end) - detector.SMALLER / 2 + 0.5) / detector.SMALLER)
                y, x = np.mgrid[: heat.shape[0], : heat.shape[1]]
                away = (x - at[0]) ** 2 + (y - at[1]) ** 2
                if flag == 2:
                    heat = np.maximum(heat, np.exp(-0.5 * away / SPREAD_PX**2).astype(np.float32))
                else:  # there, and not seen: neither right nor wrong
                    counts[away < UNSURE_PX**2] = 0.0
            counts[heat > 0.1] = 1.0
            self.grey.append(grey)
            self.small.append(small.astype(np.float16))
            self.heat.append(heat)
            self.counts.append(counts.astype(np.float16))
            self.ends.append(known[known[:, 2] == 2, :2])

    def parts(self, size: int = 12) -> Any:
        """Parts of pictures for `find`, two of three with an end in them."""
        found = []
        for number in self._rng.integers(len(self.small), size=size):
            rows, columns = self.heat[number].shape
            row, column = self._rng.integers((rows - PART, columns - PART))
            if len(ends := self.ends[number]) and self._rng.random() < 0.67:
                at = ends[self._rng.integers(len(ends))] / detector.SMALLER
                at = at + self._rng.uniform(-35, 35, 2)
                column, row = np.clip(at - PART / 2, 0, (columns - PART, rows - PART)).astype(int)
            part = slice(row, row + PART), slice(column, column + PART)
            x = self.small[number][:, *part].astype(np.float32)
            x[0] *= self._rng.uniform(0.7, 1.3)
            x[1] = x[1] * self._rng.uniform(0.8, 1.2) + self._rng.normal(0.0, 0.1)
            found.append((x, self.heat[number][part], self.counts[number][part].astype(np.float32)))
        return [np.stack(one) for one in zip(*found, strict=True)]

    def crops(self, size: int = 48) -> Any:
        """Parts of pictures for `place`, with where the end is in them."""
        crops: list[Any] = []
        ends: list[Any] = []
        while len(crops) < size:
            number = self._rng.integers(len(self.grey))
            if len(known := self.ends[number]):
                end = known[self._rng.integers(len(known))]
                at = np.rint(end + self._rng.uniform(-9, 9, 2)).astype(int)
                crops.append(detector.crop(self.grey[number], *at))
                ends.append(end - at + detector.CROP_PX // 2)
        return np.stack(crops), np.array(ends, dtype=np.float32), 0.0


def write(name: str, layers: Any, weights: Any, last: Any, ends: Any, said: dict[str, str]) -> None:
    """A network as STEM.NAME.onnx; ``last``: what follows its layers, whose result is "map"."""
    given = {"find": ("n", 2, "rows", "columns"), "place": ("n", 1, 64, 64)}[name]
    values = {"grid": GRID, "flat": np.array([0, 1024], np.int64)}
    nodes, there = [], "seen"
    for number, ((k, _, _, step, wide), (w, b)) in enumerate(zip(layers, weights, strict=True)):
        values |= {f"w{number}": w, f"b{number}": b}
        final = number == len(layers) - 1
        made = "map" if final else f"c{number}"
        how = {"strides": [step] * 2, "dilations": [wide] * 2, "pads": [wide * (k // 2)] * 4}
        nodes.append(helper.make_node("Conv", [there, f"w{number}", f"b{number}"], [made], **how))
        if not final:
            there = f"r{number}"
            nodes.append(helper.make_node("Relu", [made], [there]))
    nodes += [helper.make_node(kind, into, [out], **more) for kind, into, out, more in last]
    used = {name for node in nodes for name in node.input}
    graph = helper.make_graph(
        nodes,
        name,
        [helper.make_tensor_value_info("seen", TensorProto.FLOAT, given)],
        [helper.make_tensor_value_info(last[-1][2], TensorProto.FLOAT, ends)],
        [numpy_helper.from_array(value, key) for key, value in values.items() if key in used],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, said)
    onnx.checker.check_model(model)
    onnx.save(model, f"{STEM}.{name}.onnx")
    print(f"{STEM}.{name}.onnx: {sum(w.size + b.size for w, b in weights)} weights")


def main(recording: str, coco: str, find_steps: str = "2500", place_steps: str = "3000") -> None:
    rng = np.random.default_rng(1)
    pictures = Pictures(Path(recording), Path(coco), rng)
    said = {"trained_on": json.dumps(pictures.table["info"]["trained_on"])}
    print(f"{len(pictures.grey)} pictures; find:")
    weights = new(FIND, rng)
    weights[-1][1][:] = -4.0  # ends are rare
    find = trained(find_loss, weights, pictures.parts, int(find_steps), 3e-3)
    last: list[Any] = [("Sigmoid", ["map"], "heat", {})]
    write("find", FIND, find, last, ("n", 1, "rows", "columns"), said)
    print("place:")
    place = trained(place_loss, new(PLACE, rng), pictures.crops, int(place_steps), 3e-3)
    last = [
        ("Reshape", ["map", "flat"], "line", {}),
        ("Softmax", ["line"], "share", {"axis": 1}),
        ("MatMul", ["share", "grid"], "end_px", {}),
    ]
    write("place", PLACE, place, last, ("n", 2), said)


if __name__ == "__main__":
    main(*sys.argv[1:])
