// npm's @foxglove/ws-protocol against a gateway: what a robot has is seen, heard, published, called and set.
// node foxglove.js URL SUBPROTOCOL; a line on stdout for each step that the other side waits for, an exit code of 0 if all was right.
import assert from "node:assert/strict";

import { parse } from "@foxglove/rosmsg";
import { MessageReader, MessageWriter } from "@foxglove/rosmsg2-serialization";
import foxglove from "@foxglove/ws-protocol";
import WebSocket from "ws";

const [url, subprotocol] = process.argv.slice(2);
const ws = new WebSocket(url, [subprotocol]);
const client = new foxglove.FoxgloveClient({ ws });
const heard = [];
const waiting = [];

// Keeps what came, so that it does not matter whether it comes before it is waited for.
for (const event of ["serverInfo", "status", "message", "parameterValues", "serviceCallResponse", "serviceCallFailure",
  "connectionGraphUpdate", "fetchAssetResponse"]) {
  client.on(event, (what) => told(event, what));
}
for (const event of ["advertise", "unadvertise", "advertiseServices", "unadvertiseServices"]) {
  client.on(event, (all) => all.forEach((what) => told(event, what)));
}
client.on("error", (error) => fail(error));
setTimeout(() => fail(new Error(`it took too long, waiting for ${waiting.map(({ event }) => event)}`)), 30_000);

function fail(error) {
  console.error(error);
  process.exit(1);
}

function told(event, what) {
  const at = waiting.findIndex((one) => one.event === event && one.is(what));
  if (at >= 0) {
    waiting.splice(at, 1)[0].resolve(what);
  } else {
    heard.push({ event, what });
  }
}

function next(event, is = () => true) {
  const at = heard.findIndex((one) => one.event === event && is(one.what));
  if (at >= 0) {
    return Promise.resolve(heard.splice(at, 1)[0].what);
  }
  return new Promise((resolve) => waiting.push({ event, is, resolve }));
}

const named = (name) => (what) => (what.topic ?? what.name) === name;
const definition = (schema) => parse(schema, { ros2: true });

try {
  const info = await next("serverInfo");
  assert.equal(ws.protocol, subprotocol);
  assert.deepEqual(info.supportedEncodings, ["cdr", "json"]);
  for (const capability of ["clientPublish", "services", "parameters", "parametersSubscribe", "connectionGraph"]) {
    assert.ok(info.capabilities.includes(capability), capability);
  }
  assert.equal(info.metadata.ROS_DISTRO, "jazzy");

  const chatter = await next("advertise", named("/pose"));
  assert.equal(chatter.encoding, "cdr");
  assert.equal(chatter.schemaName, "geometry_msgs/msg/PoseStamped");
  assert.equal(chatter.schemaEncoding, "ros2msg");
  const subscription = client.subscribe(chatter.id);
  const message = await next("message");
  assert.equal(message.subscriptionId, subscription);
  assert.ok(message.timestamp > 1_600_000_000_000_000_000n);
  const pose = new MessageReader(definition(chatter.schema)).readMessage(message.data);
  assert.equal(pose.header.frame_id, "map");
  assert.equal(pose.pose.position.y, 2.5);
  assert.equal(pose.pose.orientation.w, 1);
  console.log("heard");
  assert.equal(await next("unadvertise"), chatter.id);

  const json = client.advertise({ topic: "/cmd", encoding: "json", schemaName: "std_msgs/msg/String" });
  client.sendMessage(json, new TextEncoder().encode(JSON.stringify({ data: "by json" })));
  const cdr = client.advertise({ topic: "/cmd", encoding: "cdr", schemaName: "std_msgs/msg/String" });
  client.sendMessage(cdr, new MessageWriter(definition("string data")).writeMessage({ data: "by cdr" }));
  client.unadvertise(json);

  const service = await next("advertiseServices", named("/switch"));
  assert.equal(service.type, "std_srvs/srv/SetBool");
  const request = new MessageWriter(definition(service.request.schema)).writeMessage({ data: true });
  client.sendServiceCallRequest({ serviceId: service.id, callId: 7, encoding: service.request.encoding, data: request });
  const response = await next("serviceCallResponse");
  assert.deepEqual([response.serviceId, response.callId, response.encoding], [service.id, 7, "cdr"]);
  const reply = new MessageReader(definition(service.response.schema)).readMessage(response.data);
  assert.deepEqual({ ...reply }, { success: true, message: "on" });
  client.sendServiceCallRequest({ serviceId: 999, callId: 8, encoding: "cdr", data: request });
  assert.equal((await next("serviceCallFailure")).callId, 8);

  client.getParameters([], "all");
  const all = await next("parameterValues", ({ id }) => id === "all");
  const parameter = (values, name) => values.parameters.find((one) => one.name === name);
  assert.equal(parameter(all, "/camera.exposure").value, 0.5);
  assert.equal(parameter(all, "/camera.exposure").type, "float64");
  assert.equal(parameter(all, "/camera.frame").value, "lens");
  client.subscribeParameterUpdates(["/camera.exposure"]);
  client.setParameters([{ name: "/camera.exposure", value: 2, type: "float64" }], "set");
  const set = await next("parameterValues", ({ id }) => id === "set");
  assert.equal(parameter(set, "/camera.exposure").value, 2);
  const event = await next("parameterValues", ({ id }) => id == undefined);
  assert.equal(parameter(event, "/camera.exposure").value, 2);

  client.subscribeConnectionGraph();
  const graph = await next("connectionGraphUpdate");
  assert.ok(graph.subscribedTopics.some(named("/cmd")));
  assert.ok(graph.advertisedServices.some(named("/switch")));

  client.fetchAsset("package://none/robot.urdf", 3);
  const asset = await next("fetchAssetResponse");
  assert.deepEqual([asset.requestId, asset.status], [3, 1]);

  assert.deepEqual(heard.filter(({ event }) => event === "status"), []);
  client.on("close", () => process.exit(0));
  client.close();
} catch (error) {
  fail(error);
}
