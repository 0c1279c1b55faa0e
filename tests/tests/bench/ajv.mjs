// Compiles every schema of a folder in ajv's strict mode and validates documents by the kind of their schema.
import { createRequire } from "node:module";
import { readFileSync, readdirSync } from "node:fs";

const [modules, schemas, documents] = process.argv.slice(2);
const Ajv = createRequire(`${modules}/`)("ajv/dist/2020").default;
const ajv = new Ajv({ strict: true, allErrors: true });
const read = (path) => JSON.parse(readFileSync(path, "utf8"));
const validators = {};
for (const file of readdirSync(schemas)) {
  const schema = read(`${schemas}/${file}`);
  if (typeof schema.$id !== "string") throw new Error(`${file}: no $id`);
  try {
    validators[file.replace(".json", "")] = ajv.compile(schema);
  } catch (error) {
    throw new Error(`${file}: ${error.message}`);
  }
}
let count = 0;
for (const [kind, list] of Object.entries(read(documents))) {
  for (const document of list) {
    if (!validators[kind](document)) throw new Error(`${kind}: ${ajv.errorsText(validators[kind].errors)}`);
    count += 1;
  }
}
console.log(`${Object.keys(validators).length} schemas, ${count} documents`);
