"""A scene as numbers, each a share of its range: to mix two scenes, and to say how far apart they
are. The pose and the paint are left out.
"""

from __future__ import annotations

import math

from bench.testing import Object, Scene, Teat

# a part's number (0 is the scene, then teats, then things), a thing's kind, a number's name
Key = tuple[int, str, str]
Numbers = dict[Key, float]


def numbers(scene: Scene) -> Numbers:
    return {
        (i, getattr(part, "kind", ""), name): getattr(part, name)
        / steps.size
        / (steps.most - steps.least)
        for i, part in enumerate((scene, *scene.teats, *scene.objects))
        for name, steps in part.STEPS.items()
    }


def built(found: Numbers, like: Scene) -> Scene:
    """A scene of these numbers; the pose and paint are of another."""
    made = dict[tuple[int, str], dict[str, float]]()
    for (i, kind, name), share in sorted(found.items()):
        steps = (Object if kind else Teat if i else Scene).STEPS[name]
        made.setdefault((i, kind), {})[name] = steps.value(
            round(share * (steps.most - steps.least))
        )
    things = tuple(Object(kind, **of) for (_, kind), of in made.items() if kind)
    teats = tuple(Teat(**of) for (i, kind), of in made.items() if i and not kind)
    return Scene(teats, like.pose, like.paint, objects=things, **made[0, ""])


def take(key: Key, new: Numbers, into: Numbers) -> None:
    """A number; all of the thing where another one, or none, stands there."""
    if key in new and key in into:
        into[key] = new[key]
        return
    for one in [one for one in into if one[0] == key[0]]:
        del into[one]
    into.update((one, share) for one, share in new.items() if one[0] == key[0])


def distance(one: Numbers, other: Numbers) -> float:
    """Root mean square, of the numbers that both have."""
    both = one.keys() & other.keys()
    return math.sqrt(sum((one[key] - other[key]) ** 2 for key in both) / len(both))
