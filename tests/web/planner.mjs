/** The planner in JavaScript: every stage, from the map to the route, against Python's numbers. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { pathToFileURL } from "node:url";

const site = `${pathToFileURL(process.env.SITE)}/`;
const { readBytes } = await import(`${site}js/files.js`);
const { loadSpecialist } = await import(`${site}js/specialist.js`);
const { Assessment } = await import(`${site}js/tensorization.js`);
const { OodScore } = await import(`${site}js/feasibility.js`);
const { fuse } = await import(`${site}js/fusion.js`);
const { Headings } = await import(`${site}js/directions.js`);
const { OURS, PAPER, plan } = await import(`${site}js/planning.js`);
const { Kernel } = await import(`${site}planner/nets/nets.js`);

const recorded = JSON.parse(readFileSync(process.env.RECORDED));
const kernel = await Kernel.load(await readBytes(`${site}planner/nets.wasm`));
const zoo = [];
for (const name of recorded.names) {
  const one = await loadSpecialist(`${site}planner/specialists/${name}`);
  zoo.push({ ...one, net: kernel.net(one.net, one.command), plain: one.net });
}
const maps = recorded.maps.map((one) => ({
  ...one,
  heights: unpacked(one.heights),
  known: Uint8Array.from(one.known),
}));
const assessments = maps.map((map) => {
  const assessment = new Assessment(map, zoo);
  assessment.assess();
  return assessment;
});

function unpacked(text) {
  const bytes = Buffer.from(text, "base64");
  return new Float32Array(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
}

/** Return the largest difference, as it is or as a share of numbers above 1. */
function differ(a, b) {
  assert.equal(a.length, b.length);
  return a.reduce(
    (worst, x, i) => Math.max(worst, Math.abs(x - b[i]) / Math.max(1, Math.abs(b[i]))),
    0,
  );
}

/** CPU time, ms: the machine may be busy. */
function cpu() {
  const { user, system } = process.cpuUsage();
  return (user + system) / 1000;
}

test("prepared maps are Python's", () => {
  maps.forEach((map, i) => {
    assert.deepEqual(assessments[i].prepared.heights, unpacked(map.prepared));
  });
});

test("f, L_recon and strangeness", (t) => {
  const worst = { f: 0, reconstruction: 0, strangeness: 0 };
  maps.forEach((map, m) => {
    zoo.forEach((_, i) => {
      for (const name in worst) {
        const error = differ(assessments[m].said[i][name], unpacked(map.said[i][name]));
        worst[name] = Math.max(worst[name], error);
      }
    });
  });
  t.diagnostic(`largest difference from Python's: ${JSON.stringify(worst)}`);
  for (const name in worst) assert.ok(worst[name] < 1e-5, `${name} differs by ${worst[name]}`);
});

test("nets in WebAssembly are those in JavaScript", () => {
  const random = Float32Array.from({ length: 90 * 70 }, (_, i) => 0.3 * Math.sin(i * i));
  for (const { net, plain, command } of zoo) {
    assert.ok(differ(net.feasibility(random), plain.feasibility(random, command)) < 2e-6);
    const [fast, slow] = [net.losses(random), plain.losses(random)];
    for (const name in fast) assert.ok(differ(fast[name], slow[name]) < 1e-5, name);
  }
});

for (const [name, settings] of Object.entries({ ours: OURS, paper: PAPER })) {
  test(`weights, fusion and routes with the settings "${name}"`, (t) => {
    const worst = { weight: 0, F: 0, fused: 0, cost: 0, promise: 0 };
    const count = { routes: 0, "same cells": 0, refusals: 0 };
    const note = (what, error) => (worst[what] = Math.max(worst[what], error));
    maps.forEach((map, m) => {
      const assessment = assessments[m];
      const told = map.settings[name];
      const weighed = zoo.map((one, i) => assessment.weigh(i, new OodScore(settings.taus, one)));
      weighed.forEach(({ weight, weighted }, i) => {
        note("weight", differ(weight, unpacked(told.weights[i])));
        note("F", differ(weighted, unpacked(told.tensors[i])));
      });
      const tensors = weighed.map(({ weighted }) => weighted);
      const { fused, policyMap } = fuse(tensors);
      note("fused", differ(fused, unpacked(told.fused)));
      // Where the two best are nearly equal, either may be taken.
      unpacked(told.policies).forEach((policy, n) => {
        if (policy !== policyMap[n]) assert.ok(Math.abs(tensors[policy][n] - fused[n]) < 5e-5);
      });
      const { known, ends: steps, headings } = assessment;
      const problem = { tensors, fused, policyMap, map: assessment.map, known, steps, headings };
      for (const one of told.answers) {
        const { route, refusal } = plan({ ...problem, start: one.start, goal: one.goal, settings });
        if (one.refused) {
          count.refusals++;
          const words = {
            UnknownCellError: /never observed/,
            InfeasibleCellError: /no policy can (leave the start|enter the goal)/,
            UnreachableError: /no chain of steps/,
            DoubtfulRouteError: /the cheapest route, .* promises/,
          };
          assert.match(refusal.reason, words[one.refused]);
          continue;
        }
        assert.ok(route, refusal?.reason);
        count.routes++;
        note("cost", Math.abs(route.cost - one.cost) / one.cost);
        note("promise", Math.abs(route.promise - one.promise));
        assert.ok(Math.abs(route.costs.reduce((sum, cost) => sum + cost, 0) - route.cost) < 1e-9);
        const same =
          JSON.stringify(route.cells) === JSON.stringify(one.cells) &&
          JSON.stringify(route.policies) === JSON.stringify(one.policies);
        count["same cells"] += same;
      }
    });
    t.diagnostic(`${name}: largest differences ${JSON.stringify(worst)}; ${JSON.stringify(count)}`);
    // Our p-value is steep where L_recon is far out: what torch rounds off in float32 grows there.
    const limit = name === "ours" ? 5e-5 : 1e-5;
    for (const what of ["weight", "F", "fused"])
      assert.ok(worst[what] < limit, `${what} ${worst[what]}`);
    assert.ok(worst.cost < 1e-6, `cost ${worst.cost}`);
    assert.ok(worst.promise < 1e-6);
    // The paper's cost has many ties (a diagonal step costs no more): there, equal costs are enough.
    if (name === "ours") assert.ok(count["same cells"] >= count.routes - 1);
  });
}

test("a stroke of the brush gives what a fresh assessment gives, for the windows that see it", (t) => {
  const { nx, ny } = maps[1];
  const fresh = (heights) => {
    const anew = new Assessment({ ...maps[1], heights }, zoo);
    anew.assess();
    return anew;
  };
  const one = fresh(maps[1].heights);
  for (const [ix, iy] of [
    [20, 20],
    [0, 5],
    [nx - 1, ny - 1],
  ]) {
    const heights = Float32Array.from(one.map.heights);
    for (const i of [ix, Math.max(ix - 1, 0)]) heights[i * ny + iy] += 0.1;
    const began = cpu();
    const windows = one.reassess(heights);
    const passed = cpu() - began;
    t.diagnostic(`cell (${ix}, ${iy}): ${windows.length} windows, ${passed.toFixed(0)} ms of CPU`);
    assert.ok(windows.length > 0 && windows.length < 0.2 * one.size);
    const anew = fresh(heights);
    zoo.forEach((_, i) => {
      for (const name in anew.said[i]) assert.deepEqual(one.said[i][name], anew.said[i][name]);
    });
  }
});

test("any number of headings: steps, and no step over a closed cell", () => {
  for (const [number, steps] of Object.entries(recorded.steps)) {
    const count = Number(number);
    const headings = new Headings(count);
    assert.deepEqual(headings.steps.map(([a, b]) => [a + 0, b + 0]), steps);
    headings.yaws.slice(1).forEach((yaw, i) => assert.ok(yaw > headings.yaws[i]));
    const usable = new Uint8Array(49).fill(1);
    usable[24] = 0;
    headings.stepsWithin(usable, 7, 7).forEach((end, at) => {
      if (end < 0) return;
      const [cell, k] = [Math.floor(at / count), at % count];
      assert.ok(cell !== 24 && end !== 24);
      const passed = headings.between[k].map(([a, b]) => cell + a * 7 + b);
      assert.ok(!passed.includes(24));
    });
  }
  assert.deepEqual(new Headings(16).between[1], [
    [1, 0],
    [1, 1],
  ]);
});
