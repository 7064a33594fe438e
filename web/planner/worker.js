/**
 * The planner off the page's own thread: assesses the map, weighs, fuses and plans.
 *
 * Reads requests `{heights | map, team, settings, start, goal}`; answers with every stage. What a
 * request leaves as it was is not computed again: sliders ask no net, a stroke of the brush only
 * for the windows that see it.
 */

import { Headings } from "../js/directions.js";
import { OodScore } from "../js/feasibility.js";
import { readBytes } from "../js/files.js";
import { fuse } from "../js/fusion.js";
import { plan } from "../js/planning.js";
import { loadSpecialist } from "../js/specialist.js";
import { Assessment } from "../js/tensorization.js";
import { Kernel } from "./nets/nets.js";

const headings = new Headings(8);
let zoo = [];
let assessment = null;
/** w_ood and F_i of each policy, and for which taus they were weighed. */
let weighed = [];
let weighedFor = "";

/** Load the specialists; their nets run in nets.wasm. */
async function load({ base, names }) {
  const kernel = await Kernel.load(await readBytes(new URL("nets.wasm", base)));
  zoo = await Promise.all(
    names.map((name) => loadSpecialist(new URL(`specialists/${name}/`, base))),
  );
  for (const one of zoo) one.net = kernel.net(one.net, one.command);
  postMessage({ kind: "loaded" });
}

/** Answer a request, stage by stage. */
function answer({ map, heights, team, settings, start, goal }) {
  const began = performance.now();
  const progress = (share) => postMessage({ kind: "progress", share });
  let windows = 0;
  if (map) {
    assessment = new Assessment(map, zoo, headings);
    windows = assessment.assess(progress).length;
  } else if (heights) {
    windows = assessment.reassess(heights).length;
  }
  const assessed = performance.now();
  const taus = JSON.stringify([settings.taus, settings.alpha]);
  if (map || heights || taus !== weighedFor) {
    weighed = zoo.map((one, i) =>
      assessment.weigh(i, new OodScore(settings.taus, one, settings.alpha)),
    );
    weighedFor = taus;
  }
  const tensors = team.map((i) => weighed[i].weighted);
  const { fused, policyMap } = fuse(tensors);
  const { known, ends } = assessment;
  const problem = { tensors, fused, policyMap, map: assessment.map, known, steps: ends, headings };
  const found = plan({ ...problem, start, goal, settings });
  if (found.route) found.route.policies = found.route.policies.map((i) => team[i]);
  postMessage({
    kind: "answer",
    ...found,
    why: found.refusal?.nearest ? why(found.refusal, team) : [],
    weights: weighed.map(({ weight }) => weight),
    fused,
    policyMap: policyMap.map((i) => team[i]),
    windows,
    milliseconds: {
      nets: assessed - began,
      plan: performance.now() - assessed,
    },
  });
}

/** Say for each policy of the team what it finds of the step on from the nearest place reached. */
function why({ nearest: [ix, iy], heading }, team) {
  const at = (ix * assessment.map.ny + iy) * headings.count + heading;
  return team.map((i) => {
    const w = weighed[i].weight[at];
    const known = w >= 0.5 ? "it knows such ground" : "it has hardly seen such ground";
    const f = weighed[i].weighted[at].toFixed(2);
    return `${zoo[i].name}: F = ${f}, w_ood = ${w.toFixed(2)} (${known})`;
  });
}

onmessage = async ({ data }) => {
  try {
    if (data.kind === "load") await load(data);
    else answer(data);
  } catch (error) {
    postMessage({ kind: "failed", words: error.message });
  }
};
