// npm's roslib against a gateway: its documented examples, topics in every compression, services, parameters and actions both
// ways. node roslib.js URL; "all is well" and an exit code of 0 if all was right.
import assert from "node:assert/strict";

import { Action, Param, Ros, Service, Topic } from "roslib";

const [url] = process.argv.slice(2);
setTimeout(() => fail(new Error(`it took too long: ${step}`)), 60_000);
let step = "connect";

function fail(error) {
  console.error(error);
  process.exit(1);
}

/** What calls back once, as a promise. */
const once = (begin) => new Promise((resolve, reject) => begin(resolve, (why) => reject(new Error(String(why)))));

async function connect() {
  const ros = new Ros();
  ros.on("error", fail);
  ros.on("status", (status) => fail(new Error(status.msg)));
  const connected = new Promise((resolve) => ros.once("connection", resolve));
  await ros.connect(url);
  await connected;
  return ros;
}

const STRING = "std_msgs/String";

async function topics(ros, other) {
  step = "hear a program";
  for (const compression of ["none", "cbor", "cbor-raw"]) {
    const listener = new Topic({ ros, name: "/chatter", messageType: STRING, compression });
    const heard = await new Promise((resolve) => listener.subscribe(resolve));
    listener.unsubscribe();
    if (compression === "cbor-raw") {
      assert.ok(heard.secs > 1_500_000_000 && heard.bytes instanceof Uint8Array);
      assert.match(new TextDecoder().decode(heard.bytes.slice(8, -1)), /^hello \d+$/);
    } else {
      assert.match(heard.data, /^hello \d+$/, compression);
    }
  }

  step = "typed arrays of cbor";
  const scan = new Topic({ ros, name: "/scan", messageType: "sensor_msgs/LaserScan", compression: "cbor" });
  const ranges = new Promise((resolve) => scan.subscribe(resolve));
  const scanner = new Topic({ ros: other, name: "/scan", messageType: "sensor_msgs/LaserScan", latch: true });
  scanner.publish({ header: { frame_id: "laser" }, ranges: [0.5, 1.5, null] });
  const seen = await ranges;
  assert.ok(seen.ranges instanceof Float32Array);
  assert.deepEqual([...seen.ranges], [0.5, 1.5, NaN]);
  assert.ok(seen.header.stamp.sec > 1_500_000_000);
  scan.unsubscribe();
  scanner.unadvertise();

  step = "publish to a program and back";
  const command = new Topic({ ros, name: "/cmd_vel", messageType: "geometry_msgs/Twist" });
  const echo = new Topic({ ros: other, name: "/cmd_vel", messageType: "geometry_msgs/Twist", queue_length: 5 });
  const driven = new Promise((resolve) => echo.subscribe(resolve));
  other.callOnConnection({ op: "set_level", level: "error" });
  await once((done, failed) => other.getTopics(done, failed));
  command.publish({ linear: { x: 0.25 }, angular: { z: -1 } });
  assert.deepEqual(await driven, { linear: { x: 0.25, y: 0, z: 0 }, angular: { x: 0, y: 0, z: -1 } });
  const publishers = await once((done, failed) => echo.getPublishers(done, failed));
  assert.deepEqual(publishers, ["/sgc_gateway"]);
  echo.unsubscribe();
  command.unadvertise();

  step = "pieces";
  const long = new Promise((resolve) => other.once("/long", resolve));
  other.callOnConnection({ op: "subscribe", topic: "/long", type: STRING, fragment_size: 1000 });
  await once((done, failed) => other.getTopics(done, failed));
  const text = "ä€𝄞".repeat(5000);
  new Topic({ ros, name: "/long", messageType: STRING }).publish({ data: text });
  assert.equal((await long).msg.data, text);

  step = "png";
  const told = new Promise((resolve) => ros.once("status:png", resolve));
  ros.callOnConnection({ op: "subscribe", id: "png", topic: "/chatter", type: STRING, compression: "png" });
  assert.match((await told).msg, /take "cbor"/);
}

async function services(ros, other) {
  step = "call a program";
  const onNetwork = new Service({ ros, name: "/switch", serviceType: "std_srvs/SetBool" });
  const answer = await once((done, failed) => onNetwork.callService({ data: true }, done, failed));
  assert.deepEqual(answer, { success: true, message: "on" });
  const refused = once((done, failed) => onNetwork.callService({ wrong: 1 }, done, failed));
  await assert.rejects(refused, /there is no member "wrong"/);

  step = "serve";
  const served = new Service({ ros, name: "/js/add", serviceType: "example_interfaces/AddTwoInts" });
  await served.advertise((request, response) => {
    response.sum = request.a + request.b;
    return true;
  });
  const later = new Service({ ros, name: "/js/later", serviceType: "std_srvs/Trigger" });
  await later.advertiseAsync(async () => ({ success: true, message: "later" }));
  await once((done, failed) => ros.getServices(done, failed));
  const add = new Service({ ros: other, name: "/js/add", serviceType: "example_interfaces/AddTwoInts" });
  assert.deepEqual(await once((done, failed) => add.callService({ a: 2, b: 40 }, done, failed)), { sum: 42 });
  const trigger = new Service({ ros: other, name: "/js/later", serviceType: "std_srvs/Trigger" });
  assert.equal((await once((done, failed) => trigger.callService({}, done, failed))).message, "later");
  await served.unadvertise();
  await later.unadvertise();
  await once((done, failed) => ros.getServices(done, failed));
  await assert.rejects(once((done, failed) => add.callService({ a: 1, b: 1 }, done, failed, 1)));
}

async function introspection(ros) {
  step = "look around";
  const ask = (name, ...args) => once((done, failed) => ros[name](...args, done, failed));
  const { topics, types } = await ask("getTopics");
  assert.equal(types[topics.indexOf("/chatter")], "std_msgs/msg/String");
  assert.deepEqual(await ask("getTopicsForType", "std_msgs/msg/String").then((all) => all.includes("/chatter")), true);
  assert.equal(await ask("getTopicType", "/chatter"), "std_msgs/msg/String");
  assert.ok((await ask("getServices")).includes("/switch"));
  assert.deepEqual(await ask("getServicesForType", "std_srvs/srv/SetBool"), ["/switch"]);
  assert.equal(await ask("getServiceType", "/switch"), "std_srvs/srv/SetBool");
  assert.ok((await ask("getNodes")).includes("/sgc_gateway"));
  assert.ok((await ask("getNodeDetails", "/sgc_gateway")).services.includes("/switch"));
  assert.deepEqual(await ask("getActionServers"), ["/fibonacci"]);
  const request = await ask("getServiceRequestDetails", "std_srvs/srv/SetBool");
  assert.deepEqual(ros.decodeTypeDefs(request.typedefs), { data: "boolean" });
  const response = await ask("getServiceResponseDetails", "std_srvs/srv/SetBool");
  assert.deepEqual(ros.decodeTypeDefs(response.typedefs), { success: "boolean", message: "string" });
  const typedefs = await ask("getMessageDetails", "geometry_msgs/msg/PoseArray");
  const vector = { x: "double", y: "double", z: "double" };
  assert.deepEqual(ros.decodeTypeDefs(typedefs), {
    header: { stamp: { sec: "int32", nanosec: "uint32" }, frame_id: "string" },
    poses: [{ position: vector, orientation: { ...vector, w: "double" } }],
  });
  const raw = await ask("getTopicsAndRawTypes");
  assert.match(raw.typedefs_full_text[raw.topics.indexOf("/chatter")], /string data/);

  step = "parameters";
  assert.deepEqual(await ask("getParams"), ["/arm:speed"]);
  const speed = new Param({ ros, name: "/arm:speed" });
  assert.equal(await once((done, failed) => speed.get(done, failed)), 0.5);
  await once((done, failed) => speed.set(2, done, failed));
  assert.equal(await once((done, failed) => speed.get(done, failed)), 2);
  const missing = new Param({ ros, name: "/arm:missing" });
  await assert.rejects(once((done, failed) => missing.get(done, failed)), /not declared/);
  await once((done, failed) => speed.set(0.5, done, failed));
}

const FIBONACCI = "example_interfaces/action/Fibonacci";

async function actions(ros, other) {
  step = "a goal for a program";
  const fibonacci = new Action({ ros, name: "/fibonacci", actionType: FIBONACCI });
  const told = [];
  const result = await once((done, failed) =>
    fibonacci.sendGoal({ order: 4 }, done, (feedback) => told.push(feedback.sequence), failed));
  assert.deepEqual(result, { sequence: [0, 1, 1, 2, 3] });
  assert.deepEqual(told, [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]]);

  step = "a goal that is canceled";
  let id;
  const canceled = once((done, failed) => {
    id = fibonacci.sendGoal({ order: 10 }, done, () => fibonacci.cancelGoal(id), failed);
  });
  await assert.rejects(canceled, /Action was canceled/);
  const all = once((done, failed) => {
    fibonacci.sendGoal({ order: 10 }, done, () => new Action({ ros: other, name: "/fibonacci" }).cancelAllGoals(), failed);
  });
  const error = console.error;
  console.error = () => {};
  await assert.rejects(all, /Action was canceled/);

  step = "serve an action";
  console.error = error;
  const served = new Action({ ros, name: "/js/count", actionType: FIBONACCI });
  const goals = new Map();
  served.advertise(
    (goal, id) => {
      served.sendFeedback(id, { sequence: [goal.order] });
      if (goal.order === 1) {
        served.setSucceeded(id, { sequence: [1] });
      } else if (goal.order === 2) {
        served.setFailed(id);
      }
      goals.set(id, goal);
    },
    (id) => served.setCanceled(id, { sequence: [-1] }),
  );
  await once((done, failed) => ros.getActionServers(done, failed));
  const count = new Action({ ros: other, name: "/js/count", actionType: FIBONACCI });
  const heard = [];
  const send = (order, then) => once((done, failed) => {
    const id = count.sendGoal({ order }, done, ({ sequence }) => { heard.push(sequence[0]); then?.(id); }, failed);
  });
  assert.deepEqual(await send(1), { sequence: [1] });
  await assert.rejects(send(2), /Action was aborted/);
  await assert.rejects(send(3, (id) => count.cancelGoal(id)), /Action was canceled.*-1/);
  assert.deepEqual([heard, goals.size], [[1, 2, 3], 3]);
  served.unadvertise();
}

try {
  const [ros, other] = [await connect(), await connect()];
  await topics(ros, other);
  await services(ros, other);
  await introspection(ros);
  await actions(ros, other);
  step = "close";
  const closed = new Promise((resolve) => ros.once("close", resolve));
  ros.close();
  await closed;
  console.log("all is well");
  process.exit(0);
} catch (error) {
  console.error(step);
  fail(error);
}
