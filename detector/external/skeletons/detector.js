// A teat detector: a program that gets and gives JSON lines.
//
// Question: {"frame": "1", "left": "left.png", "right": "...", "thermal": "...",
//            "thermal_radiometric": "...", "calibration": "calibration.toml"}
// Answer:   {"frame": "1", "teats": [...], "hidden": 0, "reason": "..."}
//
// Standard output is for answers only. Write anything else with console.error.

const readline = require("node:readline");

// Change this. asked.left and asked.right are paths of grey PNG files.
function find(asked) {
  // a teat in pixels [column, row] of both pictures: the bench calculates the point in space
  const teat = { left_px: [750.0, 425.0], right_px: [622.0, 456.0] };
  // or in millimetres of the world: { world_mm: [-160.0, 205.0, 136.0] }
  return { teats: [teat], hidden: 0, reason: "skeleton: the same teat in every picture" };
}

console.log(JSON.stringify({ ready: true }));
readline.createInterface({ input: process.stdin }).on("line", (line) => {
  const asked = JSON.parse(line);
  console.log(JSON.stringify({ frame: asked.frame, ...find(asked) }));
});
