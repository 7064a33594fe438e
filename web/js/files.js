/**
 * Files beside the page, or on disk in Node: their bytes, inflated where their name ends in .gz, so
 * that any static server will do.
 */

/**
 * Return the bytes of a file.
 *
 * @param {string | URL} address - Absolute, or relative to the page.
 * @returns {Promise<ArrayBuffer>}
 */
export async function readBytes(address) {
  const url = new URL(address, globalThis.document?.baseURI);
  let answer;
  if (url.protocol === "file:" && !globalThis.document) {
    const { readFile } = await import("node:fs/promises");
    answer = new Response(await readFile(url));
  } else {
    answer = await fetch(url);
    if (!answer.ok) throw new Error(`cannot load ${url.pathname}: ${answer.status}`);
  }
  const gzipped = url.pathname.endsWith(".gz") && !answer.headers.has("content-encoding");
  if (!gzipped) return answer.arrayBuffer();
  return new Response(answer.body.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

/**
 * Return an address for a module of JavaScript whose file is compressed.
 *
 * @param {string | URL} address
 * @param {Record<string, string>} imports - What it imports by another address than it says.
 */
export async function inflateModule(address, imports = {}) {
  let text = new TextDecoder().decode(await readBytes(address));
  for (const [said, meant] of Object.entries(imports)) text = text.replaceAll(said, meant);
  return URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
}

/** Return the JSON of a file. */
export async function readJson(address) {
  return JSON.parse(new TextDecoder().decode(await readBytes(address)));
}
