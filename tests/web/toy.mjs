/** The toy in JavaScript: drives of Python's replayed step by step, and driven anew. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { pathToFileURL } from "node:url";

const site = `${pathToFileURL(process.env.SITE)}/`;
const { readBytes } = await import(`${site}js/files.js`);
const { loadSpecialist } = await import(`${site}js/specialist.js`);
const { loadMunk } = await import(`${site}planner/munk/munk.js`);
const { Toy, World } = await import(`${site}planner/toy.js`);
const { Drive } = await import(`${site}planner/drive.js`);

const { names, drives } = JSON.parse(readFileSync(process.env.RECORDED));
const munk = await loadMunk(await readBytes(`${site}planner/munk.wasm`));
const zoo = [];
for (const name of names) {
  zoo.push(await loadSpecialist(`${site}planner/specialists/${name}`, { net: false }));
}

/** Steps that are replayed before the least difference in a contact has had time to grow. */
const SURE = 100;

function unpacked(text) {
  const bytes = Buffer.from(text, "base64");
  return new Float32Array(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
}

function world(drive) {
  const ground = { ...drive, heights: unpacked(drive.heights) };
  return new World(ground, { ...drive, heights: unpacked(drive.prepared) });
}

function differ(a, b) {
  assert.equal(a.length, b.length);
  return a.reduce((worst, value, i) => Math.max(worst, Math.abs(value - b[i])), 0);
}

test("recorded actions give the recorded states and observations", (t) => {
  let alike = 0;
  for (const drive of drives) {
    const toy = new Toy(munk(), world(drive));
    for (const pose of drive.places) toy.place(...pose.map(Math.fround));
    const policy = (n) => zoo[drive.policies[n]];
    const worst = { state: 0, observation: 0, action: 0 };
    let steps = 0;
    for (const { command, observation, action, state } of drive.steps) {
      toy.command.set(command);
      const seen = toy.observe();
      const [felt, did] = [differ(seen, observation), differ(policy(steps).act(seen), action)];
      toy.advance(action);
      const moved = differ(toy.state, state);
      // Two contacts a substep apart: from there on the drives part.
      if (moved > 1e-6) break;
      steps++;
      worst.state = Math.max(worst.state, moved);
      worst.observation = Math.max(worst.observation, felt);
      worst.action = Math.max(worst.action, did);
    }
    t.diagnostic(`${steps} of ${drive.steps.length} steps alike: ${JSON.stringify(worst)}`);
    alike += steps >= SURE;
    assert.ok(worst.observation < 1e-4 && worst.action < 1e-4);
  }
  t.diagnostic(`${alike} of ${drives.length} drives agree to 1e-6 for ${SURE} steps or more`);
  assert.ok(alike >= 0.8 * drives.length);
});

test("driven anew by the follower, they end as in Python", (t) => {
  let alike = 0;
  for (const drive of drives) {
    const one = new Drive(munk(), world(drive), drive.route, zoo, () => 0);
    one.toy.place(...drive.places.at(-1).map(Math.fround));
    while (!one.step());
    t.diagnostic(`${one.reason}, in Python ${drive.reason}; ${one.seconds.toFixed(1)} s`);
    alike += one.reason === drive.reason;
  }
  t.diagnostic(`${alike} of ${drives.length} end alike`);
  assert.ok(alike >= drives.length - 1);
});

test("without its policies it fails: wheels alone drop into a gap", () => {
  const drive = drives[0];
  const heights = unpacked(drive.heights).map((_, cell) =>
    Math.abs(Math.floor(cell / drive.ny) - 30) < 3 ? -1 : 0,
  );
  const flat = { ...drive, heights };
  const toy = new Toy(munk(), new World(flat, flat));
  toy.place(1.5 + 1, 1.5 + 2, 0);
  toy.command.set([0.5, 0, 0]);
  let steps = 0;
  while (!toy.fallen() && steps++ < 500) toy.advance([0, 0, 0, 0]);
  assert.ok(steps < 500, "it should not cross half a metre of nothing");
});
