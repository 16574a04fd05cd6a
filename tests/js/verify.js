// A page in headless Chromium verifies a gateway that makes its certificate itself: by the imported certificate, or by the
// flag with its pin. node verify.js PORT OTHER-PORT STOLEN-PORT PIN CA DIRECTORY; "all is well" and an exit code of 0 if all was right.
// The gateway at PORT has the names localhost, 127.0.0.1 and robot.test. The one at OTHER-PORT has the same names and
// another key. At STOLEN-PORT somebody has the key of the first, and made a certificate for bank.test with it.
// crates/sgc-gateway/tests/browser.rs has them.
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { once } from "node:events";
import { mkdirSync } from "node:fs";
import { createServer } from "node:http";

import { begin, fail, launch, limit } from "./chromium.js";

const [port, other, stolen, pin, ca, directory] = process.argv.slice(2);
limit(110_000);

const HOSTS = "MAP robot.test 127.0.0.1, MAP other.test 127.0.0.1, MAP bank.test 127.0.0.1, MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1";
const NAMES = ["localhost", "127.0.0.1", "robot.test"];

// A page of this host, which the gateway admits.
const server = createServer((_, response) => response.writeHead(200, { "content-type": "text/html" }).end("<p>page"));
server.listen(0, "127.0.0.1");
await once(server, "listening");
const site = `http://localhost:${server.address().port}/`;

/** Starts a browser of a user who has imported that certificate, if there is one. */
async function user(name, certificate, flags = []) {
  const home = `${directory}/${name}`;
  const database = `${home}/.pki/nssdb`;
  mkdirSync(database, { recursive: true });
  execFileSync("certutil", ["-d", `sql:${database}`, "-N", "--empty-password"]);
  if (certificate) {
    execFileSync("certutil", ["-d", `sql:${database}`, "-A", "-n", "gateway", "-t", "C,,", "-i", certificate]);
  }
  const browser = await launch(`${home}/data`, HOSTS, { env: { ...process.env, HOME: home } }, flags);
  const page = await browser.newPage();
  await page.goto(site);
  return { browser, page };
}

/** "open", or how Chromium says that the WebSocket failed. */
async function open(page, url) {
  const failed = new Promise((resolve) => {
    page.once("websocket", (socket) => socket.once("socketerror", (error) => resolve(String(error))));
  });
  const opened = page.evaluate(
    (url) =>
      new Promise((resolve) => {
        const socket = new WebSocket(url);
        socket.onopen = () => resolve("open");
        socket.onerror = () => resolve("error");
      }),
    url,
  );
  return (await opened) === "open" ? "open" : failed;
}

try {
  begin("a user who imported nothing");
  const stranger = await user("stranger");
  for (const name of NAMES) {
    assert.match(await open(stranger.page, `wss://${name}:${port}/`), /ERR_CERT_AUTHORITY_INVALID/);
  }
  await stranger.browser.close();

  begin("a user who imported the certificate");
  const member = await user("member", ca);
  for (const name of NAMES) {
    assert.equal(await open(member.page, `wss://${name}:${port}/`), "open", name);
  }
  assert.match(await open(member.page, `wss://other.test:${port}/`), /ERR_CERT_COMMON_NAME_INVALID/);
  assert.match(await open(member.page, `wss://robot.test:${other}/`), /ERR_CERT_AUTHORITY_INVALID/);
  assert.match(await open(member.page, `wss://bank.test:${stolen}/`), /ERR_CERT_/);
  await member.browser.close();

  begin("a browser that is started with the pin");
  const kiosk = await user("kiosk", undefined, [`--ignore-certificate-errors-spki-list=${pin.replace("sha256/", "")}`]);
  for (const name of NAMES) {
    assert.equal(await open(kiosk.page, `wss://${name}:${port}/`), "open", name);
  }
  assert.match(await open(kiosk.page, `wss://robot.test:${other}/`), /ERR_CERT_AUTHORITY_INVALID/);
  // The pin takes the place of the name, too.
  assert.equal(await open(kiosk.page, `wss://other.test:${port}/`), "open");
  await kiosk.browser.close();

  console.log("all is well");
  process.exit(0);
} catch (error) {
  fail(error);
}
