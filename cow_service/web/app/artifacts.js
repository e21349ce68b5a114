// Artifacts by their digest, as addresses for pictures and videos. With a key they are fetched: an <img> sends none.

import { useEffect, useState } from "../vendor/htm-preact.js";
import { address } from "./address.js";
import { currentKey } from "./keys.js";
import { call } from "./server.js";

const MOST_HELD = 100; // fetched artifacts; beyond, those that were asked for first are forgotten
const held = new Map(); // digest: promise of an address

const release = (promise) => promise.then((url) => URL.revokeObjectURL(url), () => {});

async function fetched(sha256) {
  return URL.createObjectURL(await artifactBlob(sha256));
}

/** The address of an artifact. Throws `Problem` where it is gone. */
export function artifactAddress(sha256) {
  if (currentKey() === null) return Promise.resolve(address(`/artifacts/${sha256}`));
  if (!held.has(sha256)) {
    const address = fetched(sha256);
    held.set(sha256, address);
    address.catch(() => held.delete(sha256));
    if (held.size > MOST_HELD) {
      const [oldest, promise] = held.entries().next().value;
      held.delete(oldest);
      void release(promise);
    }
  }
  return held.get(sha256);
}

/** The bytes of an artifact: a canvas may not read what another server sent to an <img>. */
export const artifactBlob = async (sha256) => (await call(`/artifacts/${sha256}`)).blob();

/** Forgets what was fetched with a key. */
export function forgetArtifacts() {
  for (const promise of held.values()) void release(promise);
  held.clear();
}

/** The address of an artifact; null until it is there, and where it is gone. */
export function useArtifact(sha256) {
  const [found, setFound] = useState({ sha256: null, url: null });
  useEffect(() => {
    let wanted = true;
    if (sha256) artifactAddress(sha256).then((url) => wanted && setFound({ sha256, url }), () => {});
    return () => {
      wanted = false;
    };
  }, [sha256]);
  return found.sha256 === sha256 ? found.url : null;
}

/** Has the browser save bytes under a name. */
export function saveAs(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
