// SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
// SPDX-License-Identifier: Apache-2.0

// Prints a line for every message of MCAP files: topic, times, digests of its bytes and values.
// node read_bag.mjs FILE...

import { createHash } from 'node:crypto';
import { open } from 'node:fs/promises';

import { parse } from '@foxglove/rosmsg';
import { MessageReader } from '@foxglove/rosmsg2-serialization';
import { McapIndexedReader } from '@mcap/core';
import { decompress } from 'fzstd';

const FLOATS = new Set(['float32', 'float64']);

// Adds all values of a message to a hash, in the order of its definition.
class Values {
  constructor(definitions) {
    this.byName = new Map(definitions.map((d) => [d.name ?? '', d]));
    this.root = definitions.find((d) => d.name == undefined) ?? definitions[0];
  }

  digest(message) {
    this.hash = createHash('sha256');
    this.add(this.root, message);
    return this.hash.digest('hex');
  }

  add(definition, message) {
    for (const field of definition.definitions.filter((f) => f.isConstant !== true)) {
      const value = message[field.name];
      if (field.isArray !== true) {
        this.addValue(field, value);
        continue;
      }
      this.hash.update(`[${value.length}]`);
      for (const item of value) {
        this.addValue(field, item);
      }
    }
  }

  addValue(field, value) {
    if (field.type === 'time' || field.type === 'duration') {
      this.hash.update(`${value.sec};${value.nsec ?? value.nanosec};`);
    } else if (field.isComplex === true) {
      this.add(this.byName.get(field.type), value);
    } else if (FLOATS.has(field.type)) {
      const bytes = Buffer.alloc(8);
      bytes.writeDoubleBE(value);
      this.hash.update(`${bytes.toString('hex')};`);
    } else if (field.type === 'string') {
      this.hash.update(`${Buffer.from(value, 'utf8').toString('hex')};`);
    } else {
      this.hash.update(`${Number.isInteger(value) ? value : BigInt(value)};`);
    }
  }
}

function sha256(data) {
  return createHash('sha256').update(data).digest('hex');
}

async function readFile(path) {
  const file = await open(path);
  const { size } = await file.stat();
  const readable = {
    size: async () => BigInt(size),
    read: async (offset, length) => {
      const buffer = new Uint8Array(Number(length));
      await file.read(buffer, 0, Number(length), Number(offset));
      return buffer;
    },
  };
  const reader = await McapIndexedReader.Initialize({
    readable,
    decompressHandlers: { zstd: (data, length) => decompress(data, new Uint8Array(Number(length))) },
  });
  const decoders = new Map();
  for await (const message of reader.readMessages()) {
    const channel = reader.channelsById.get(message.channelId);
    if (!decoders.has(channel.schemaId)) {
      const schema = reader.schemasById.get(channel.schemaId);
      const definitions = parse(new TextDecoder().decode(schema.data), { ros2: true });
      decoders.set(channel.schemaId, [new MessageReader(definitions), new Values(definitions)]);
    }
    const [decoder, values] = decoders.get(channel.schemaId);
    const digest = values.digest(decoder.readMessage(message.data));
    console.log(
      [channel.topic, message.logTime, message.publishTime, sha256(message.data), digest].join(' '),
    );
  }
  await file.close();
}

for (const path of process.argv.slice(2)) {
  await readFile(path);
}
