// Headless Chromium for a test that runs in steps. A test that fails says at which.
import { chromium } from "playwright-core";

let step = "start";

/** Names the step that begins. */
export function begin(name) {
  step = name;
}

/** Ends the program with an error. */
export function fail(error) {
  console.error(step);
  console.error(error);
  process.exit(1);
}

/** Fails after this time, in milliseconds. */
export function limit(most) {
  setTimeout(() => fail(new Error("it took too long")), most);
}

/** Starts the browser with its data in a new directory. It finds the hosts of these rules, and no other at all. */
export function launch(directory, hosts, options = {}, flags = []) {
  const executablePath = process.env.SGC_CHROMIUM || "/usr/bin/chromium";
  begin(`start ${executablePath}`);
  return chromium.launchPersistentContext(directory, {
    ...options,
    executablePath,
    headless: true,
    args: [
      "--no-sandbox",
      "--disable-gpu",
      "--disable-quic",
      "--no-first-run",
      "--disable-background-networking",
      "--disable-component-update",
      "--disable-sync",
      "--no-proxy-server",
      `--host-resolver-rules=${hosts}`,
      ...flags,
    ],
  });
}
