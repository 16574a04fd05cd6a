// A client of the gateway with grpc-js and gateway.proto alone: node grpc.js PROTO PORT TOKEN
// What it finds on the network is written in clients/python/tests/against_gateway.py.
"use strict";

const assert = require("node:assert");
const grpc = require("@grpc/grpc-js");
const protoLoader = require("@grpc/proto-loader");

const [proto, port, token] = process.argv.slice(2);
const definition = protoLoader.loadSync(proto, { keepCase: true, longs: String, enums: String, defaults: true, oneofs: true });
const { Gateway } = grpc.loadPackageDefinition(definition).sgc.gateway.v1;
const options = { "grpc.max_receive_message_length": 64 << 20, "grpc.max_send_message_length": 64 << 20 };
const gateway = new Gateway(`127.0.0.1:${port}`, grpc.credentials.createInsecure(), options);
const metadata = new grpc.Metadata();
metadata.set("authorization", `Bearer ${token}`);

const json = (value) => Buffer.from(JSON.stringify(value));
const unary = (method, request, options = {}) =>
  new Promise((resolve, reject) => {
    const done = (error, response) => (error ? reject(error) : resolve(response));
    gateway[method](request, metadata, options, done);
  });

/** Messages of a stream, one after the other; the first says that it has begun. */
async function* responses(call) {
  try {
    yield* call;
  } catch (error) {
    if (error.code !== grpc.status.CANCELLED) throw error;
  }
}

async function take(stream) {
  const { value, done } = await stream.next();
  assert(!done, "the stream goes on");
  return value;
}

async function topics() {
  for (const [encoding, read] of [
    ["ENCODING_JSON", (payload) => JSON.parse(payload).data],
    ["ENCODING_CDR", (payload) => payload.subarray(8, -1).toString()],
  ]) {
    const call = gateway.Subscribe({ topic: "/chatter", encoding, depth: 5 }, metadata);
    const heard = responses(call);
    assert.equal((await take(heard)).subscribed.type, "std_msgs/msg/String");
    const { message } = await take(heard);
    assert.match(read(message.payload), /^hello \d+$/);
    assert(BigInt(message.source_time_ns) > 0n);
    call.cancel();
  }
  const denied = responses(gateway.Subscribe({ topic: "/secret" }, metadata));
  await assert.rejects(denied.next(), { code: grpc.status.PERMISSION_DENIED });

  const published = new Promise((resolve, reject) => {
    const stream = gateway.Publish(metadata, (error, response) => (error ? reject(error) : resolve(response)));
    const publisher = { topic: "/echoed", type: "std_msgs/msg/String", encoding: "ENCODING_JSON" };
    stream.write({ publisher });
    const call = gateway.Subscribe({ topic: "/echoed", type: "std_msgs/String", encoding: "ENCODING_JSON" }, metadata);
    const heard = responses(call);
    (async () => {
      await take(heard);
      stream.write({ payload: json({ data: "from Node" }) });
      assert.equal(JSON.parse((await take(heard)).message.payload).data, "from Node");
      // What takes 13 MB passes, too.
      const large = "x".repeat(13 << 20);
      stream.write({ payload: json({ data: large }) });
      assert.equal(JSON.parse((await take(heard)).message.payload).data, large);
      call.cancel();
      stream.end();
    })().catch(reject);
  });
  assert.equal((await published).published, "2");
}

async function services() {
  const serving = gateway.Serve(metadata);
  const server = { service: "/js/switch", type: "std_srvs/srv/SetBool", encoding: "ENCODING_JSON" };
  serving.write({ server });
  const told = responses(serving);
  assert.equal((await take(told)).served.type, "std_srvs/srv/SetBool");
  const call = unary("Call", {
    service: "/js/switch",
    encoding: "ENCODING_JSON",
    payload: json({ data: true }),
  });
  const { request } = await take(told);
  assert.deepEqual(JSON.parse(request.payload), { data: true });
  serving.write({ reply: { id: request.id, payload: json({ success: true, message: "by Node" }) } });
  assert.equal(JSON.parse((await call).payload).message, "by Node");
  const late = unary(
    "Call",
    { service: "/js/switch", encoding: "ENCODING_JSON", payload: json({}) },
    { deadline: Date.now() + 500 },
  );
  await assert.rejects(late, { code: grpc.status.DEADLINE_EXCEEDED });
  serving.end();
}

async function main() {
  const { graph } = await unary("GetGraph", {});
  assert(graph.topics.some(({ name }) => name === "/chatter"));
  await topics();
  await services();
  gateway.close();
  console.log("grpc-js: all is well");
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
