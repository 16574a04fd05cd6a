// A page with roslib in headless Chromium against a gateway: a camera on a canvas. From this host it is admitted, from
// elsewhere only with a token, and then within its scope.
// node camera.js URL TOKEN DIRECTORY, a new one for the browser's data; "all is well" and an exit code of 0 if all was right.
// What it finds on the network is written in crates/sgc-gateway/tests/browser.rs.
import assert from "node:assert/strict";
import { once } from "node:events";
import { readFile } from "node:fs/promises";
import { createServer } from "node:http";
import { extname } from "node:path";

import { begin, fail, launch, limit } from "./chromium.js";

const [gateway, token, directory] = process.argv.slice(2);
limit(90_000);

const TYPES = { ".html": "text/html", ".js": "text/javascript", ".mjs": "text/javascript" };

/** What is in this directory, as any server of files has it. */
async function serve() {
  const server = createServer(async (request, response) => {
    const { pathname } = new URL(request.url, "http://localhost");
    try {
      const content = await readFile(new URL(`.${pathname}`, import.meta.url));
      response.writeHead(200, { "content-type": TYPES[extname(pathname)] }).end(content);
    } catch {
      response.writeHead(404).end();
    }
  });
  server.listen(0, "127.0.0.1");
  await once(server, "listening");
  return server.address().port;
}

const [WIDTH, HEIGHT] = [64, 48];

/** The picture of this number, as a canvas has it. */
function published(number) {
  const at = (x, y, colour) => (7 * x + 31 * y + 85 * colour + 3 * number) % 256;
  const pixels = [];
  for (let y = 0; y < HEIGHT; y++) {
    for (let x = 0; x < WIDTH; x++) {
      pixels.push(at(x, y, 0), at(x, y, 1), at(x, y, 2), 255);
    }
  }
  return pixels;
}

/** Waits for another picture than this one, which has to be as it was published; its number. */
async function look(page, before) {
  const seen = await page.waitForFunction((before) => {
    const caption = document.querySelector("#picture").textContent;
    if (caption === "" || caption === before) {
      return false;
    }
    const canvas = document.querySelector("#camera");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return { caption, width: canvas.width, height: canvas.height, pixels: [...data] };
  }, before, { polling: 5 });
  const { caption, width, height, pixels } = await seen.jsonValue();
  const [, number] = caption.match(/^64 × 48, rgb8, (\d+)\.000000007 s$/) ?? assert.fail(caption);
  assert.deepEqual([width, height], [WIDTH, HEIGHT]);
  assert.deepEqual(pixels, published(Number(number)));
  return caption;
}

async function see(page) {
  const captions = new Set();
  for (let caption = ""; captions.size < 5; captions.add(caption)) {
    caption = await look(page, caption);
  }
}

/** Opens the page from that host, and tells how its WebSocket failed, if it does. */
async function open(browser, origin, url) {
  const page = await browser.newPage();
  page.on("pageerror", fail);
  const failed = new Promise((resolve) => {
    page.on("websocket", (socket) => socket.on("socketerror", resolve));
  });
  await page.goto(`${origin}/camera.html#${url}`);
  return { page, failed };
}

const shows = (page, id, text) => page.locator(id).filter({ hasText: text }).waitFor();
const text = (page, id) => page.locator(id).textContent();

try {
  const port = await serve();
  const browser = await launch(
    directory,
    "MAP dashboard.test 127.0.0.1, MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1",
  );

  begin("a page of this host");
  for (const host of ["localhost", "127.0.0.1"]) {
    const { page } = await open(browser, `http://${host}:${port}`, gateway);
    await see(page);
    await shows(page, "#odom", /^x 1\.25 m, y -0\.50 m$/);
    assert.deepEqual([await text(page, "#state"), await text(page, "#refused")], ["connected", ""]);
    await page.close();
  }

  begin("a page of elsewhere");
  const elsewhere = `http://dashboard.test:${port}`;
  const stranger = await open(browser, elsewhere, gateway);
  await shows(stranger.page, "#state", "connected");
  assert.equal(await text(stranger.page, "#state"), "not connected");
  // What Chromium says of a 401.
  assert.match(await stranger.failed, /HTTP Authentication failed/);
  assert.deepEqual([await text(stranger.page, "#picture"), await text(stranger.page, "#odom")], ["", ""]);
  assert.equal(await stranger.page.evaluate(() => location.origin), elsewhere);

  begin("a page of elsewhere with a token");
  const guest = await open(browser, elsewhere, `${gateway}?token=${token}`);
  await see(guest.page);
  const refused = "subscribe: dashboard may not subscribe to /odom: its scope does not have it";
  await shows(guest.page, "#refused", refused);
  assert.deepEqual([await text(guest.page, "#state"), await text(guest.page, "#odom")], ["connected", ""]);

  begin("close");
  await browser.close();
  console.log("all is well");
  process.exit(0);
} catch (error) {
  fail(error);
}
