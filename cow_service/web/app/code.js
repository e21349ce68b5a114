// The request on the screen as curl, Python and JSON.

import { serverAddress } from "./address.js";

const LONG = 100; // characters of a line
const ARGUMENT = " ".repeat(8); // before an argument of the Python call

/** The body as JSON; `sha256` is the picture's, where the server keeps it. */
export function jsonOf(request, sha256) {
  const image = sha256 ? { artifact: sha256 } : "data:image/png;base64,...";
  return JSON.stringify({ image, ...request }, null, 2);
}

const shellQuoted = (text) => `'${text.replaceAll("'", "'\\''")}'`;

/** A curl command for a shell. `image` is the name of a file. */
export function curlOf(kind, { question, ...rest }, image, withKey) {
  const lines = [`curl ${serverAddress()}/${kind}`];
  if (withKey) lines.push('-H "Authorization: Bearer $COW_API_KEY"');
  lines.push(`-F ${shellQuoted(`image=@"${image.replaceAll(/["\\]/g, "\\$&")}"`)}`, `--form-string ${shellQuoted(`question=${question}`)}`);
  if (Object.keys(rest).length) lines.push(`--form-string ${shellQuoted(`request=${JSON.stringify(rest)}`)}`);
  return lines.join(" \\\n  ");
}

/** A JSON value as Python writes it, after so much indentation. */
function python(value, indent) {
  if (value === null) return "None";
  if (value === true) return "True";
  if (value === false) return "False";
  if (typeof value !== "object") return typeof value === "string" ? JSON.stringify(value) : String(value);
  const deeper = `${indent}    `;
  const [open, close] = Array.isArray(value) ? "[]" : "{}";
  const parts = Array.isArray(value)
    ? value.map((part) => python(part, deeper))
    : Object.entries(value).map(([name, part]) => `${JSON.stringify(name)}: ${python(part, deeper)}`);
  const line = `${open}${parts.join(", ")}${close}`;
  if (line.length + indent.length <= LONG && !line.includes("\n")) return line;
  return `${open}\n${parts.map((part) => `${deeper}${part},\n`).join("")}${indent}${close}`;
}

/** A Python program with the SDK. */
export function pythonOf(kind, { question, ...rest }, image) {
  const options = Object.entries(rest).map(([name, value]) => `${name}=${python(value, ARGUMENT)}`);
  const values = [python(image, ARGUMENT), python(question, ARGUMENT), ...options];
  return `from cow_service.client import Client

with Client("${serverAddress()}") as client:  # the key comes from COW_API_KEY
    result = client.${kind}(
${values.map((value) => `${ARGUMENT}${value},\n`).join("")}    )
    print(result)
    result.save("out")
`;
}
