/** Specialists and patches in JavaScript against numbers that Python recorded. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";

import { PatchGrid, samplePatches } from "../../web/js/heights.js";
import { loadSpecialist } from "../../web/js/specialist.js";

const recorded = JSON.parse(readFileSync(process.env.RECORDED));

/** Compare numbers to 1e-5 of the larger of 1 and themselves; say what the largest error is. */
function close(got, wanted, what) {
  assert.equal(got.length, wanted.length, what);
  let worst = 0;
  wanted.forEach((value, i) => {
    worst = Math.max(worst, Math.abs(got[i] - value) / Math.max(1, Math.abs(value)));
  });
  console.log(`${what}: error ${worst.toExponential(1)}`);
  assert.ok(worst < 1e-5, `${what} differs by ${worst}`);
}

for (const [folder, numbers] of Object.entries(recorded.specialists)) {
  test(folder, async () => {
    const specialist = await loadSpecialist(folder);
    const observations = numbers.observations.map((row) => Float32Array.from(row));
    const actions = observations.flatMap((row) => [...specialist.act(row)]);
    close(actions, numbers.actions.flat(), "actions");
    const patches = Float32Array.from(numbers.patches.flat());
    close(specialist.net.feasibility(patches, specialist.command), numbers.feasibility, "f");
    const { reconstruction, strangeness } = specialist.net.losses(patches);
    close(reconstruction, numbers.reconstruction, "L_recon");
    close(strangeness, numbers.strangeness, "strangeness");
  });
}

test("an observation of the wrong length is refused", async () => {
  const specialist = await loadSpecialist(Object.keys(recorded.specialists)[0]);
  assert.throws(() => specialist.act(new Float32Array(3)), /reads \d+ numbers, got 3/);
});

test("patches", () => {
  const { map, grid, poses, patches } = recorded.ground;
  const heights = { ...map, heights: Float32Array.from(map.heights) };
  close(samplePatches(heights, poses.flat(), new PatchGrid(grid)), patches.flat(), "patches");
});
