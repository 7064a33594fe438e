/**
 * What calls a patch strange, and the weight w_ood that follows (paper, Eq. 4).
 *
 * Mirrors `ood_weight` and `OodScore` of fgtutor/feasibility.py. The paper's weight is L_recon
 * between two thresholds. Ours is a p-value: the share of patches of the policy's own held-out
 * terrain that are at least as strange, twice the smaller of those by L_recon and by strangeness.
 */

/** The paper's thresholds on L_recon, summed over the patch. */
export const PAPER_TAUS = [0.1, 2.0];
/** Share of its own terrain that a policy may call less than fully familiar. */
export const ALPHA = 0.03;

/** Return w_ood = clip(1 - (L_recon - low) / (high - low), 0, 1). */
export function oodWeight(loss, low = PAPER_TAUS[0], high = PAPER_TAUS[1]) {
  return Math.min(Math.max(1 - (loss - low) / (high - low), 0), 1);
}

/** By what a patch is called strange: thresholds on L_recon, or a policy's own quantiles. */
export class OodScore {
  /**
   * @param {[number, number] | "calibrated"} taus - The paper's way, or ours.
   * @param {import("./specialist.js").Specialist} specialist - Whose quantiles are used by ours.
   * @param {number} alpha - The p-value from which a patch has full weight; ours only.
   */
  constructor(taus, specialist, alpha = ALPHA) {
    this.taus = taus === "calibrated" ? null : taus;
    this.alpha = alpha;
    if (this.taus && !(this.taus[0] < this.taus[1])) {
      throw new Error(`w_ood needs tau_low < tau_high, got ${this.taus.join(" and ")}`);
    }
    if (!this.taus) this.tails = [specialist.quantiles, specialist.strangeness].map(tail);
  }

  /** Return w_ood in [0, 1] of one patch. */
  weight(loss, strangeness) {
    if (this.taus) return oodWeight(loss, ...this.taus);
    return Math.min(this.pValue(loss, strangeness) / this.alpha, 1);
  }

  /** Return p in [0, 1], ours only. */
  pValue(loss, strangeness) {
    const [first, second] = this.tails;
    // Half of the own patches or more are stranger by either: p is 1, without a logarithm.
    if (loss <= first.usual && strangeness <= second.usual) return 1;
    return Math.min(2 * Math.min(shareBeyond(first, loss), shareBeyond(second, strangeness)), 1);
  }
}

/** Return the logarithms of quantiles and of the shares beyond them, and the median if known. */
function tail(quantiles) {
  const pairs = Object.entries(quantiles)
    .map(([level, score]) => [Number(level), score])
    .sort((a, b) => a[0] - b[0]);
  const usual = pairs.findLast(([level]) => level <= 0.5)?.[1] ?? -1;
  return {
    usual,
    x: pairs.map(([, score]) => Math.log(Math.fround(score))),
    p: pairs.map(([level]) => Math.log(Math.fround(1 - Math.fround(level)))),
  };
}

/**
 * Return the share of own patches with at least this score. Between the quantiles its logarithm is
 * linear in that of the score, and beyond the last one it falls on as steeply (a Pareto tail).
 */
function shareBeyond({ x, p }, score) {
  const at = Math.log(Math.max(score, 1e-12));
  let i = 1;
  while (i < x.length - 1 && x[i] < at) i++;
  const slope = (p[i] - p[i - 1]) / (x[i] - x[i - 1]);
  return Math.min(Math.exp(p[i - 1] + slope * (at - x[i - 1])), 1);
}
