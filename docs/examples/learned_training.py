"""Trains both networks of `learned_detector.py` on simulated scenes, and writes them as ONNX.

    python docs/examples/learned_training.py ideal,non_vertical,wet 20

Six minutes on one processor for all families. What the networks were trained on is written into
them. Needs: pip install jax onnx onnxruntime
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from learned_pictures import Pictures
from onnx import TensorProto, helper, numpy_helper

import bench

# of each layer: kernel, channels in and out, step, dilation; below 0 is cut off between two layers
FIND = (
    *((3, 2, 12, 1, 1), (3, 12, 12, 1, 2), (3, 12, 16, 1, 4)),
    *((3, 16, 16, 1, 8), (3, 16, 16, 1, 1), (1, 16, 1, 1, 1)),
)
PLACE = (5, 1, 12, 2, 1), (3, 12, 16, 1, 1), (3, 16, 16, 1, 2), (3, 16, 16, 1, 4), (1, 16, 1, 1, 1)
GRID = np.stack(np.meshgrid(*[2.0 * np.arange(32)] * 2), axis=-1).reshape(-1, 2).astype(np.float32)


def run(layers: Any, weights: Any, x: Any) -> Any:
    """The network without its last step."""
    for number, ((k, _, _, step, wide), (w, b)) in enumerate(zip(layers, weights, strict=True)):
        pad = [(wide * (k // 2),) * 2] * 2
        x = jax.lax.conv_general_dilated(x, w, (step, step), pad, rhs_dilation=(wide, wide))
        x = x + b[:, None, None]
        x = jax.nn.relu(x) if number < len(layers) - 1 else x
    return x


def find_loss(weights: Any, x: Any, heat: Any) -> Any:
    """CenterNet's focal loss (Zhou 2019, equation 1)."""
    z = run(FIND, weights, x)[:, 0]
    p, at_end = jax.nn.sigmoid(z), heat > 0.99
    hit = -jax.nn.log_sigmoid(z) * (1 - p) ** 2
    miss = -jax.nn.log_sigmoid(-z) * p**2 * (1 - heat) ** 4
    return jnp.sum(jnp.where(at_end, hit, miss)) / (1.0 + jnp.sum(at_end))


def place_loss(weights: Any, x: Any, end_px: Any) -> Any:
    """How far the mean of the map, as a distribution, is from the end."""
    heat = jax.nn.softmax(run(PLACE, weights, x).reshape(len(x), -1), axis=1)
    return jnp.mean(jnp.sum(jnp.sqrt((heat @ GRID - end_px) ** 2 + 0.1), axis=1))


def trained(layers: Any, loss: Any, rng: Any, batch: Callable[[], Any], steps: int) -> Any:
    """Weights after so many steps of Adam (Kingma 2015), its rate falling to nothing."""
    weights = []
    for k, a, b, _, _ in layers:
        drawn = rng.normal(0.0, np.sqrt(2.0 / (k * k * a)), (b, a, k, k)).astype(np.float32)
        weights.append((drawn, np.zeros(b, np.float32)))
    weights[-1][1][:] = -4.0 if layers is FIND else 0.0  # ends are rare

    def step(weights: Any, m: Any, v: Any, t: Any, *given: Any) -> Any:
        slope = jax.grad(loss)(weights, *given)
        m = jax.tree.map(lambda a, g: 0.9 * a + 0.1 * g, m, slope)
        v = jax.tree.map(lambda a, g: 0.999 * a + 0.001 * g * g, v, slope)
        now = 3e-3 * 0.5 * (1.0 + jnp.cos(jnp.pi * t / steps))

        def moved(w: Any, a: Any, b: Any) -> Any:
            return w - now * (a / (1 - 0.9**t)) / (jnp.sqrt(b / (1 - 0.999**t)) + 1e-8)

        return jax.tree.map(moved, weights, m, v), m, v

    fast = jax.jit(step)
    m = v = jax.tree.map(jnp.zeros_like, weights)
    for number in range(1, steps + 1):
        weights, m, v = fast(weights, m, v, float(number), *batch())
    return jax.tree.map(np.asarray, weights)


def write(path: Path, layers: Any, weights: Any, last: Any, shapes: Any, said: Any) -> None:
    """A network; ``last``: what follows its layers, whose result is "map"."""
    values = {"grid": GRID, "flat": np.array([0, 1024], np.int64)}
    nodes, there = [], "seen"
    for number, ((k, _, _, step, wide), (w, b)) in enumerate(zip(layers, weights, strict=True)):
        values |= {f"w{number}": w, f"b{number}": b}
        how = {"strides": [step] * 2, "dilations": [wide] * 2, "pads": [wide * (k // 2)] * 4}
        made = "map" if number == len(layers) - 1 else f"c{number}"
        nodes.append(helper.make_node("Conv", [there, f"w{number}", f"b{number}"], [made], **how))
        if made != "map":
            there = f"r{number}"
            nodes.append(helper.make_node("Relu", [made], [there]))
    nodes += [helper.make_node(kind, into, [out], **more) for kind, into, out, more in last]
    used = {name for node in nodes for name in node.input}
    ends = ("seen", shapes[0]), (last[-1][2], shapes[1])
    given, gives = (helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in ends)
    kept = [numpy_helper.from_array(value, key) for key, value in values.items() if key in used]
    graph = helper.make_graph(nodes, path.stem, [given], [gives], kept)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, said)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def main(families: Sequence[str], count: int, out: Path, steps: int, rig: str = "emulated") -> None:
    """Train on members 0 to ``count`` - 1 of each family; write both networks into ``out``."""
    rng = np.random.default_rng(1)
    pictures = Pictures(families, count, rng, rig)
    said = {"trained_on": json.dumps({family: [[0, count - 1]] for family in families})}
    find = trained(FIND, find_loss, rng, pictures.parts, steps)
    last: list[Any] = [("Sigmoid", ["map"], "heat", {})]
    shapes: Any = ("n", 2, "rows", "columns"), ("n", 1, "rows", "columns")
    write(out / "learned.find.onnx", FIND, find, last, shapes, said)
    place = trained(PLACE, place_loss, rng, pictures.crops, steps)
    last = [("Reshape", ["map", "flat"], "line", {}), ("Softmax", ["line"], "share", {"axis": 1})]
    last.append(("MatMul", ["share", "grid"], "end_px", {}))
    write(out / "learned.place.onnx", PLACE, place, last, (("n", 1, 64, 64), ("n", 2)), said)


if __name__ == "__main__":
    with bench.program(__doc__, str, int) as (names, count):
        main(names.split(","), count, Path(__file__).parent, 2500)
