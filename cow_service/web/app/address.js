// Where the server is: the page may be served under a path of its own by a proxy.

const BASE = new URL("../../", import.meta.url);

/** The address of a path of the server, such as `/jobs`. */
export const address = (path) => new URL(path.replace(/^\//, ""), BASE).href;

/** The address of the page that shows a job. */
export const jobAddress = (id) => `${BASE.pathname}?job=${encodeURIComponent(id)}`;

/** The address of the page that lists the jobs. */
export const jobsAddress = () => `${BASE.pathname}?view=jobs`;

/** The address of the page itself. */
export const pageAddress = () => BASE.pathname;

/** The server's address as callers outside the page write it. */
export const serverAddress = () => BASE.href.replace(/\/$/, "");
