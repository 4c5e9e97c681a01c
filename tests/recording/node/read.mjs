// Reads an MCAP file with @mcap/core as a web viewer does, and prints what is in it as one JSON object: by topic
// [messages, sum of all numbers that are no integers, sum of all integers modulo P, length of all texts].
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { decompress } from "fzstd";

const file = await open(process.argv[2], "r");
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const buffer = new Uint8Array(Number(length));
    await file.read(buffer, 0, buffer.length, Number(offset));
    return buffer;
  },
};
const zstd = (data, size) => decompress(data, new Uint8Array(Number(size)));
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: { zstd } });

const P = 2147483647;

function add(total, value) {
  if (typeof value === "bigint") {
    total[2] += Number(((value % BigInt(P)) + BigInt(P)) % BigInt(P));
  } else if (typeof value === "boolean" || Number.isInteger(value)) {
    total[2] += ((Number(value) % P) + P) % P;
  } else if (typeof value === "number") {
    total[1] += value;
  } else if (typeof value === "string") {
    total[3] += value.length;
  } else if (Array.isArray(value) || ArrayBuffer.isView(value)) {
    for (const one of value) add(total, one);
  } else {
    for (const key of Object.keys(value)) add(total, value[key]);
  }
  total[2] %= P;
}

const decoders = new Map();
for (const [id, channel] of reader.channelsById) {
  const schema = reader.schemasById.get(channel.schemaId);
  decoders.set(id, new MessageReader(parse(new TextDecoder().decode(schema.data), { ros2: true })));
}
const totals = {};
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const total = (totals[reader.channelsById.get(message.channelId).topic] ??= [0, 0, 0, 0]);
  total[0] += 1;
  add(total, decoders.get(message.channelId).readMessage(message.data));
}
console.log(JSON.stringify(totals));
await file.close();
