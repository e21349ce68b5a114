// The caller's API key: kept for this tab alone, for /docs too, and asked for when the server wants one.

const NAME = "cow-key";
let asking = null; // the promise of a dialog that is open
let open = null;

/** Called with a reason and a function that takes the key, or null where none is given. */
export function onKeyWanted(show) {
  open = show;
}

export const currentKey = () => sessionStorage.getItem(NAME);

export const forgetKey = () => sessionStorage.removeItem(NAME);

/** Asks for a key once, however many requests want one. Resolves to whether there is a new one. */
export function askForKey(reason) {
  asking ??= new Promise((resolve) => {
    open(reason, (key) => {
      asking = null;
      if (key) sessionStorage.setItem(NAME, key);
      resolve(Boolean(key));
    });
  });
  return asking;
}
