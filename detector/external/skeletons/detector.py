"""A teat detector: a program that gets and gives JSON lines.

Question: {"frame": "1", "left": "left.png", "right": "...", "thermal": "...",
           "thermal_radiometric": "...", "calibration": "calibration.toml"}
Answer:   {"frame": "1", "teats": [...], "hidden": 0, "reason": "..."}

Standard output is for answers only. Write anything else to standard error: print(..., file=sys.stderr)
"""

import json
import sys


def find(asked: dict[str, str]) -> dict[str, object]:
    """Change this. asked["left"] and asked["right"] are grey PNG files, for example for
    cv2.imdecode(np.fromfile(asked["left"], np.uint8), cv2.IMREAD_GRAYSCALE): cv2.imread takes no
    folder with letters as in Jürgen on Windows.
    """
    # a teat in pixels [column, row] of both pictures: the bench calculates the point in space
    teat = {"left_px": [750.0, 425.0], "right_px": [622.0, 456.0]}
    # or in millimetres of the world: {"world_mm": [-160.0, 205.0, 136.0]}
    return {"teats": [teat], "hidden": 0, "reason": "skeleton: the same teat in every picture"}


print(json.dumps({"ready": True}), flush=True)
for line in sys.stdin:
    asked = json.loads(line)
    print(json.dumps({"frame": asked["frame"], **find(asked)}), flush=True)
