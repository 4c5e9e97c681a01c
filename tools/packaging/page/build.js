// Bundles the libraries that pages draw with: `npm ci && npm run build`, typed here. bundled.json names the packages of
// which something is in a bundle. Reports are passed on with their library in them, and so with its licences.
import { build } from "esbuild";
import { readdir, readFile, writeFile, appendFile } from "node:fs/promises";

const usual = { bundle: true, minify: true, metafile: true, legalComments: "eof" };
const dashboard = await build({
  ...usual, entryPoints: { three: "three.entry.js", uplot: "uplot.entry.js" }, format: "esm", outdir: "../../../armctl/web/static",
});
const reports = await build({
  ...usual, entryPoints: { plotly: "plotly.entry.js" }, define: { global: "window" }, loader: { ".css": "empty" },
  outdir: "../../../armctl/report",
});
const packages = ({ metafile }) => [...new Set(Object.values(metafile.outputs).flatMap(({ inputs }) => Object.keys(inputs)
  .filter(path => path.startsWith("node_modules/") && inputs[path].bytesInOutput && !path.endsWith(".css"))
  .map(path => path.match(/^.*node_modules\/(?:@[^/]+\/)?[^/]+/)[0])))].sort();
for (const folder of packages(reports)) {
  const { name, version, license, author } = JSON.parse(await readFile(`${folder}/package.json`, "utf8"));
  const file = (await readdir(folder)).find(one => /^licen[cs]e/i.test(one));
  const text = file ? await readFile(`${folder}/${file}`, "utf8") : `By ${author.name || author}.`;
  await appendFile("../../../armctl/report/plotly.js", `/*! ${name} ${version}, ${license}\n${text.trim()}\n*/\n`);
}
await writeFile("bundled.json", `${JSON.stringify([...packages(dashboard), ...packages(reports)].sort(), null, 1)}\n`);
