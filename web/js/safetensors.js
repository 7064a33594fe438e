/**
 * Tensors from a safetensors file: eight bytes with the length of a JSON header, the header, then
 * the numbers, row by row and little endian. Mirrors what fgtutor/io/tensors.py reads.
 */

/**
 * @typedef {object} Tensor
 * @property {number[]} shape - Its lengths, the slowest index first.
 * @property {Float32Array | Int32Array} data - Its numbers. Indices (I64) become 32-bit numbers.
 */

/**
 * Return the tensors of a file by name.
 *
 * @param {ArrayBuffer} buffer - The whole file.
 * @returns {Map<string, Tensor>}
 */
export function parseSafetensors(buffer) {
  const length = Number(new DataView(buffer).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  const tensors = new Map();
  for (const [name, entry] of Object.entries(header)) {
    if (name === "__metadata__") continue;
    const [begin, end] = entry.data_offsets;
    const bytes = buffer.slice(8 + length + begin, 8 + length + end);
    tensors.set(name, { shape: entry.shape, data: numbers(entry.dtype, bytes, name) });
  }
  return tensors;
}

/** Return bytes as the numbers they stand for. */
function numbers(dtype, bytes, name) {
  if (dtype === "F32") return new Float32Array(bytes);
  if (dtype === "I64") return Int32Array.from(new BigInt64Array(bytes), Number);
  throw new Error(`${name} holds ${dtype}: only F32 and I64 are read`);
}
