// The page of `sgc dashboard` in headless Chromium, for a fleet of twenty nodes of which one has five hundred topics.
// node dashboard.js URL LOOK REFUSED DIRECTORY: the URLs of a page that may revoke, of one that only looks, and of one whose
// node is no operator, and a new directory for the browser's data and the pictures. It revokes `arm-05` and writes
// "revoked". It writes "kill", waits until the death of the node `arm-03` shows, and writes "all is well".
// crates/sgc/tests/dashboard.rs has the fleet.
import assert from "node:assert/strict";

import { begin, fail, launch, limit } from "./chromium.js";

const [url, look, refused, directory] = process.argv.slice(2);
const PATIENCE = { timeout: 60_000 };
limit(240_000);

try {
  const browser = await launch(directory, "MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", {
    viewport: { width: 1400, height: 1000 },
    colorScheme: "light",
  });
  const page = await browser.newPage();
  const complaints = [];
  const listen = (page) => {
    page.on("console", (message) => ["error", "warning"].includes(message.type()) && complaints.push(message.text()));
    page.on("pageerror", (error) => complaints.push(error.message));
  };
  listen(page);
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
  // Its path, rate, messages, age, drops and state.
  const cells = await page.locator("#topics tr td").allTextContents();
  assert.deepEqual([...cells.slice(0, 2), ...cells.slice(4, 9)], ["share", "/topic_499", "–", "0.0", "0", "–", "–"]);
  assert.match(cells[9], /waits for a local publisher/);
  const link = await page.locator("#links tr td").allTextContents();
  assert.match(link.join("|"), /^router\|a router\|[0-9.]+ ms\|(–|[0-9.]+ %)\|this node$/);

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

  begin("rights");
  await page.locator("#rights-shown", { hasText: "100 of 504 interfaces, 23 of 23 columns" }).waitFor(PATIENCE);
  const right = async (rule, column) => {
    const names = await page.locator("#rights-head th").allTextContents();
    assert.ok(names.includes(column), names.join());
    const cell = page.locator(`#rights tr[data-key="1 ${rule}"] > *`).nth(names.indexOf(column));
    return (await cell.locator(".right").allTextContents()).join(" ");
  };
  for (const [rule, column, rights] of [
    ["arm-00 /odom", "arm-00", "own"],
    ["arm-00 /odom", "arm-01", "sub"],
    ["arm-00 /odom", "router", ""],
    ["arm-00 /cmd_vel", "router", ""],
    ["arm-00 /odom", "partner:acme", "sub"],
    ["arm-00 /cmd_vel", "desk", "sub pub"],
    ["arm-00 /cmd_vel", "arm-01", ""],
    ["arm-00 /cmd_vel", "partner:acme", ""],
    ["arm-00 /camera/**", "busy", "sub"],
    ["arm-00 /camera/**", "desk", "sub"],
    ["arm-00 /camera/**", "keeper", ""],
    ["arm-00 service /reset", "desk", "call"],
    ["arm-00 service /reset", "busy", "call"],
    ["arm-00 service /reset", "arm-01", ""],
    ["busy /topic_0", "desk", "sub"],
    ["busy /topic_0", "busy", "own"],
    ["busy /topic_0", "arm-02", ""],
  ]) {
    assert.equal(await right(rule, column), rights, `${column} at ${rule}`);
  }
  const camera = page.locator('#rights tr[data-key="1 arm-00 /camera/**"]');
  assert.match(await camera.textContent(), /except \/camera\/raw.*group:observers, ▲ ghost \(no member has this name\)/);
  await page.locator("#rights-notes", { hasText: "ghost has rights, but no member has this name" }).waitFor(PATIENCE);
  await page.locator("#rights-notes", { hasText: "the rules of: absent" }).waitFor(PATIENCE);
  await page.locator("#rights-title").scrollIntoViewIfNeeded();
  await page.locator("#rights-title").evaluate((title) => title.scrollIntoView());
  await page.screenshot({ path: `${directory}/rights.png` });
  // The head and the interfaces stay in sight.
  const place = (selector) => page.locator(selector).first().evaluate((cell) => cell.getBoundingClientRect().top);
  const top = await place("#rights-head th");
  await page.locator("#matrix").focus();
  await page.keyboard.press("End");
  await page.waitForFunction(() => document.getElementById("matrix").scrollTop > 500, null, PATIENCE);
  assert.equal(await place("#rights-head th"), top);
  await page.locator("#rights-more").click();
  await page.locator("#rights-shown", { hasText: "200 of 504 interfaces" }).waitFor(PATIENCE);
  await page.fill("#rights-filter", "TOPIC_499");
  await page.fill("#members-filter", "arm-1");
  await page.locator("#rights-shown", { hasText: "1 of 504 interfaces, 7 of 23 columns" }).waitFor(PATIENCE);
  await page.fill("#rights-filter", "group:operators");
  await page.locator("#rights-shown", { hasText: "2 of 504 interfaces" }).waitFor(PATIENCE);
  await page.fill("#rights-filter", "");
  await page.fill("#members-filter", "");

  begin("light and dark");
  const background = () => page.evaluate(() => getComputedStyle(document.body).backgroundColor);
  const light = await background();
  await page.emulateMedia({ colorScheme: "dark" });
  assert.notEqual(await background(), light);
  await page.screenshot({ path: `${directory}/dark.png`, fullPage: true });
  await page.locator("#rights-title").evaluate((title) => title.scrollIntoView());
  await page.screenshot({ path: `${directory}/rights-dark.png` });
  await page.emulateMedia({ colorScheme: "light" });

  begin("another token");
  const stranger = await browser.newPage();
  await stranger.goto(url.replace(/#.*/, "#0123"));
  await stranger.locator("#error", { hasText: "open the URL that `sgc dashboard` printed" }).waitFor(PATIENCE);
  assert.equal(await stranger.locator("#nodes tr").count(), 0);
  await stranger.close();

  begin("direct and relayed peers");
  const network = await browser.newPage();
  listen(network);
  // These nodes have no data to exchange, so the server's document gets the peers of one.
  await network.route("**/api/fleet*", async (route) => {
    const response = await route.fetch();
    const answer = await response.json();
    const member = (name) => answer.view.fleet.nodes.find((node) => node.name === name)?.member?.id;
    const report = answer.view?.fleet.nodes.find((node) => node.name === "arm-07")?.report;
    if (report) {
      assert.deepEqual([report.not_direct, report.not_direct_omitted, report.links[0].direct], [[], 0, false]);
      report.links.push({ ...report.links[0], peer: member("arm-08"), direct: true });
      report.not_direct = [
        { peer: member("busy"), name: "B", reason: "blocked" },
        { peer: "0123456789", name: "elsewhere", reason: "of_tomorrow" },
      ];
      report.not_direct_omitted = 3;
    }
    await route.fulfill({ response, json: answer });
  });
  await network.goto(look);
  await network.locator('#nodes tr[data-key="1 arm-07"] button').click(PATIENCE);
  await network.locator("#details-title", { hasText: "arm-07" }).waitFor(PATIENCE);
  assert.match(await network.locator("#links tr", { hasText: "arm-08" }).textContent(), /^arm-08itself/);
  const relayed = await network.locator("#not-direct tr").allTextContents();
  assert.equal(relayed.length, 2);
  assert.match(relayed[0], /^busyno packet passes between the two networks.*run sgc netcheck at both nodes/);
  assert.match(relayed[1], /^elsewherea reason of another version/);
  assert.equal(await network.locator("#not-direct-more").textContent(), "and 3 more");
  assert.equal(await network.locator("#map line.direct").count(), 1);
  await network.locator('#nodes tr[data-key="1 arm-08"] button').click(PATIENCE);
  await network.locator("#details-title", { hasText: "arm-08" }).waitFor(PATIENCE);
  assert.equal(await network.locator("#not-direct").isVisible(), false);
  await network.close();

  begin("a page that only looks");
  const looking = await browser.newPage();
  listen(looking);
  await looking.goto(look);
  await looking.locator('#nodes tr[data-key="1 arm-05"] button').click(PATIENCE);
  await looking.locator("#details-title", { hasText: "arm-05" }).waitFor(PATIENCE);
  assert.equal(await looking.locator("#revoke-ask").isVisible(), false);
  await looking.close();

  begin("a node that is no operator");
  const powerless = await browser.newPage();
  await powerless.goto(refused);
  await powerless.locator('#nodes tr[data-key="1 arm-05"] button').click(PATIENCE);
  await powerless.locator("#revoke-ask").click(PATIENCE);
  await powerless.fill("#revoke-name", "arm-05");
  await powerless.keyboard.press("Enter");
  const reason = "keeper does not take this node for an operator: operators in its [authority] has to name it or a group of it";
  await powerless.locator("#revoke-said", { hasText: reason }).waitFor(PATIENCE);
  await powerless.screenshot({ path: `${directory}/refused.png` });
  await powerless.close();

  begin("revoke");
  await row("arm-05").locator("button").focus();
  await page.keyboard.press("Enter");
  await page.locator("#details-title", { hasText: "arm-05" }).waitFor(PATIENCE);
  await page.keyboard.press("Tab");
  assert.equal(await page.evaluate(() => document.activeElement.id), "revoke-ask");
  await page.keyboard.press("Enter");
  await page.locator("#revoke-title", { hasText: "Revoke arm-05?" }).waitFor(PATIENCE);
  for (const name of ["arm-0", "arm-055", "ARM-05", "arm-06"]) {
    await page.fill("#revoke-name", name);
    assert.equal(await page.locator("#revoke-do").isDisabled(), true, name);
    await page.keyboard.press("Enter");
  }
  await page.keyboard.press("Escape");
  assert.equal(await page.locator("#revoke").isVisible(), false);
  await rowShows("arm-05", "● here");
  await page.locator("#revoke-ask").click();
  assert.equal(await page.inputValue("#revoke-name"), "");
  await page.keyboard.type("arm-05");
  await page.screenshot({ path: `${directory}/revoke.png` });
  await page.keyboard.press("Enter");
  await rowShows("arm-05", "✕ revoked");
  assert.equal(await page.locator("#revoke").isVisible(), false);
  assert.equal(await page.locator("#revoke-ask").isVisible(), false);
  await page.locator("#rights-shown", { hasText: "22 of 22 columns" }).waitFor(PATIENCE);
  await rowShows("arm-06", "● here");
  console.log("revoked");

  begin("audit");
  await page.fill("#audit-filter", "keeper operation");
  const event = page.locator("#audit tr", { hasText: "revoke arm-05: done" });
  await event.waitFor(PATIENCE);
  assert.match(await event.textContent(), /^\d{4}-\d\d-\d\d \d\d:\d\d:\d\dkeeperoperationdesk/);
  await page.fill("#audit-filter", "no operator");
  await page.locator("#audit tr", { hasText: "busy" }).waitFor(PATIENCE);
  await page.fill("#audit-filter", "desk started");
  await page.locator("#audit-shown", { hasText: "the newest 1 of 1" }).waitFor(PATIENCE);
  await page.fill("#audit-filter", "");
  await page.locator("#audit-title").evaluate((title) => title.scrollIntoView());
  await page.screenshot({ path: `${directory}/audit.png` });

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
