/**
 * Fuse the feasibility tensors of all specialists: the highest feasibility, and its policy
 * (paper, Sec. III-C, Eqs. 6-7). Mirrors fgtutor/fusion.py.
 */

/**
 * Return F_max = max_i F_i and P = argmax_i F_i; on a tie the first specialist is taken.
 *
 * @param {Float32Array[]} tensors - F_i of each policy.
 * @returns {{fused: Float32Array, policyMap: Uint8Array}}
 */
export function fuse(tensors) {
  if (!tensors.length) throw new Error("fuse needs at least one feasibility tensor");
  const fused = Float32Array.from(tensors[0]);
  const policyMap = new Uint8Array(fused.length);
  tensors.slice(1).forEach((tensor, i) => {
    for (let n = 0; n < fused.length; n++) {
      if (tensor[n] > fused[n]) {
        fused[n] = tensor[n];
        policyMap[n] = i + 1;
      }
    }
  });
  return { fused, policyMap };
}
