// Gets openapi.json, with the server's key where it asks for one, and shows it in Swagger UI.

const KEY_NAME = "cow-key"; // in sessionStorage: kept for this tab only
const SCHEME = "key"; // of components.securitySchemes
const UNAUTHORIZED = 401;

const form = document.getElementById("key-form");
const field = document.getElementById("key");
const message = document.getElementById("message");

form.addEventListener("submit", (event) => {
  event.preventDefault();
  load(field.value.trim());
});
load(sessionStorage.getItem(KEY_NAME) ?? "");

async function load(key) {
  message.textContent = "";
  form.inert = true; // a second key waits for what becomes of the first
  try {
    const headers = key ? { Authorization: `Bearer ${key}` } : {};
    const response = await fetch("openapi.json", { headers });
    const body = await response.json();
    if (response.status === UNAUTHORIZED) return askForKey(key ? body.detail : "");
    if (!response.ok) throw new Error(body.detail);
    if (key) sessionStorage.setItem(KEY_NAME, key);
    show(body, key);
  } catch (error) {
    message.textContent = `The API cannot be shown: ${error.message} Reload the page to try again.`;
  } finally {
    form.inert = false;
  }
}

function askForKey(reason) {
  sessionStorage.removeItem(KEY_NAME);
  message.textContent = reason;
  form.hidden = false;
  form.inert = false;
  field.value = "";
  field.focus();
}

function show(document_, key) {
  form.hidden = true;
  // Where a proxy serves COW under a path, requests go below that path.
  const base = new URL(".", location.href).href.replace(/\/$/, "");
  const spec = { ...document_, servers: document_.servers ?? [{ url: base }] };
  const ui = SwaggerUIBundle({
    spec,
    dom_id: "#api",
    deepLinking: true,
    defaultModelsExpandDepth: 0,
    docExpansion: "list",
    validatorUrl: null, // else specifications go to a service of others
    onComplete: () => key && ui.preauthorizeApiKey(SCHEME, key),
  });
}
