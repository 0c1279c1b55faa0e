// Reads an MCAP file with @mcap/core and prints topics, rows and schemas as JSON, numbers as they were parsed.
import { createRequire } from "node:module";
import { open } from "node:fs/promises";

const require = createRequire(`${process.argv[2]}/`);
const { McapIndexedReader } = require("@mcap/core");
const { decompress } = require("lz4js");

const file = await open(process.argv[3], "r");
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const buffer = new Uint8Array(Number(length));
    await file.read(buffer, 0, buffer.length, Number(offset));
    return buffer;
  },
};
const decompressHandlers = { lz4: (data, size) => decompress(data, Number(size)) };
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const parse = (data) => JSON.parse(new TextDecoder().decode(data));
const topics = {};
for await (const message of reader.readMessages()) {
  const { topic } = reader.channelsById.get(message.channelId);
  (topics[topic] ??= []).push({ logTime: message.logTime.toString(), row: parse(message.data) });
}
const schemas = [...reader.schemasById.values()].map((schema) => parse(schema.data));
const compressions = [...new Set(reader.chunkIndexes.map((chunk) => chunk.compression))];
console.log(JSON.stringify({ topics, schemas, compressions }));
