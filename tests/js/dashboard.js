// The page of `sgc dashboard` in headless Chromium, for a fleet of twenty nodes of which one has five hundred topics.
// node dashboard.js URL DIRECTORY, a new one for the browser's data and the pictures. It writes "kill" once all is there,
// waits until the death of the node `arm-03` shows, and writes "all is well". crates/sgc/tests/dashboard.rs has the fleet.
import assert from "node:assert/strict";

import { begin, fail, launch, limit } from "./chromium.js";

const [url, directory] = process.argv.slice(2);
const PATIENCE = { timeout: 60_000 };
limit(240_000);

try {
  const browser = await launch(directory, "MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", {
    viewport: { width: 1400, height: 1000 },
    colorScheme: "light",
  });
  const page = await browser.newPage();
  const complaints = [];
  page.on("console", (message) => ["error", "warning"].includes(message.type()) && complaints.push(message.text()));
  page.on("pageerror", (error) => complaints.push(error.message));
  page.on("request", (request) => assert.ok(request.url().startsWith(new URL(url).origin), request.url()));
  const row = (name) => page.locator(`#nodes tr[data-key="1 ${name}"]`);
  const rowShows = (name, text) => row(name).filter({ hasText: text }).waitFor(PATIENCE);

  begin("the fleet");
  await page.goto(url);
  for (let n = 0; n < 17; n++) await rowShows(`arm-${String(n).padStart(2, "0")}`, "● here");
  await rowShows("busy", "● here");
  await rowShows("router", "● here");
  await rowShows("absent", "○ no report");
  assert.equal(await page.locator("#nodes tr").count(), 22);
  assert.equal(await page.locator("#map .node").count(), 22);
  await page.locator("#summary", { hasText: "22 nodes, 21 here, 1 without a report; 1 of them needs attention" }).waitFor(PATIENCE);
  await page.locator("#faults li", { hasText: "absent: it is not in reach" }).waitFor(PATIENCE);
  assert.equal(await page.locator("#map line").count(), 20);
  await page.screenshot({ path: `${directory}/fleet.png` });

  begin("five hundred topics");
  await row("busy").locator("button").click();
  await page.locator("#shown", { hasText: "500 of 500" }).waitFor(PATIENCE);
  assert.equal(await page.locator("#topics tr").count(), 500);
  await page.fill("#filter", "topic_499");
  await page.locator("#shown", { hasText: "1 of 500" }).waitFor(PATIENCE);
  assert.match(await page.locator("#topics tr").textContent(), /share\/topic_499.*waits for a local publisher/);

  begin("why");
  await page.locator("#topics button").click();
  await page.locator("#steps li", { hasText: "✗ no publisher of /topic_499 is on the local network" }).waitFor(PATIENCE);
  await page.keyboard.press("Escape");
  assert.equal(await page.locator("#why").isVisible(), false);

  begin("the keyboard");
  await page.locator('#map .node[data-key="1 arm-07"]').focus();
  await page.keyboard.press("Enter");
  await page.locator("#details-title", { hasText: "arm-07" }).waitFor(PATIENCE);
  assert.equal(await page.evaluate(() => document.activeElement.id), "details-title");
  const kept = row("arm-07").locator("button");
  await kept.focus();
  const seen = await page.locator("#facts").textContent();
  assert.match(seen, /node id[0-9a-f]{64}/);

  begin("light and dark");
  const background = () => page.evaluate(() => getComputedStyle(document.body).backgroundColor);
  const light = await background();
  await page.emulateMedia({ colorScheme: "dark" });
  assert.notEqual(await background(), light);
  await page.screenshot({ path: `${directory}/dark.png`, fullPage: true });

  begin("another token");
  const stranger = await browser.newPage();
  await stranger.goto(url.replace(/#.*/, "#0123"));
  await stranger.locator("#error", { hasText: "open the URL that `sgc dashboard` printed" }).waitFor(PATIENCE);
  assert.equal(await stranger.locator("#nodes tr").count(), 0);
  await stranger.close();

  begin("a node dies");
  await kept.focus();
  console.log("kill");
  await rowShows("arm-03", "○ no report, seen");
  await page.locator("#faults li", { hasText: "absent, arm-03: it is not in reach" }).waitFor(PATIENCE);
  await rowShows("arm-04", "● here");
  // New documents, with another fault above, leave the focus where it is.
  assert.equal(await kept.evaluate((button) => button === document.activeElement), true);
  await page.screenshot({ path: `${directory}/dead.png` });
  assert.deepEqual(complaints, []);

  begin("close");
  await browser.close();
  console.log("all is well");
  process.exit(0);
} catch (error) {
  fail(error);
}
