/** The browser's Python: every exercise that it offers, solved and untouched, by the course's checks. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { fileURLToPath, pathToFileURL } from "node:url";

const folder = pathToFileURL(`${process.env.SITE}/`);
const { loadPyodide } = await import(new URL("pyodide/pyodide.mjs", folder));
const lock = JSON.parse(readFileSync(new URL("pyodide/pyodide-lock.json", folder)));
const began = process.cpuUsage();
const python = await loadPyodide({
  indexURL: fileURLToPath(new URL("pyodide/", folder)),
  packages: Object.keys(lock.packages).filter((name) => lock.packages[name].imports.length === 0),
});
await python.runPythonAsync(`
import contextlib, io, json, linecache, os
import re
from fgtutor.course import checks

os.makedirs("/work")
os.chdir("/work")

def run(source, variables, name):
    linecache.cache[name] = (len(source), None, source.splitlines(True), name)
    exec(compile(source, name, "exec"), variables)

def outcomes(exercise, content):
    """Return [question, outcome untouched, outcome solved, what was said] for each question."""
    cells = [
        "".join(cell["source"]) for cell in json.loads(content)["cells"] if cell["cell_type"] == "code"
    ]
    variables = {"__name__": "__main__"}
    for number, source in enumerate(cells):
        if not re.match(r"(check|case|hint|solution|with_mine)\\(", source):
            run(source, variables, f"<{exercise} cell {number}>")
    solutions = json.loads(checks.SOLUTIONS.read_text())
    found = []
    for asked in checks.questions_of(exercise):
        untouched = checks.check(asked.id, variables[asked.name])
        run(solutions[asked.id], variables, f"<{asked.id}>")
        solved = checks.check(asked.id, variables[asked.name])
        found.append([asked.id, untouched.outcome, solved.outcome, solved.detail])
    return json.dumps(found)

def planner(exercise):
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert checks.with_mine(exercise) is None
    return said.getvalue()
`);
const passed = process.cpuUsage(began);
console.log(`# Python, numpy and the checks: ${Math.round((passed.user + passed.system) / 1e3)} ms of CPU time`);

for (const name of process.env.EXERCISES.split(" ")) {
  test(`${name}: solutions pass and are kept, what is untouched does not pass`, () => {
    const content = readFileSync(new URL(`${name}.ipynb`, folder), "utf8");
    const rows = JSON.parse(python.globals.get("outcomes")(name, content));
    assert.ok(rows.length > 0);
    for (const [question, untouched, solved, said] of rows) {
      assert.equal(untouched, "not started", question);
      assert.equal(solved, "passed", `${question}: ${said}`);
      // Node has no storage of a browser: mine.py lies in memory, and that is said.
      assert.match(said, /^Kept in mine\.py until this page closes|^Kept in mine\.py\.$/m, question);
    }
    assert.match(python.globals.get("planner")(name), /needs torch, which is not here/);
  });
}

test("networkx is loaded once a cell imports it", async () => {
  const source = "import networkx as nx\nnx.dijkstra_path(nx.path_graph(4), 0, 3)";
  await python.loadPackagesFromImports(source);
  assert.deepEqual(python.runPython(source).toJs(), [0, 1, 2, 3]);
});
