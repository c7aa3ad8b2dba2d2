// Builds a Raw Ingest packet from a message; for a function node.
//
//   msg.payload   numbers (0 to 65535; for bits 0, 1, false, true), or a Buffer with the payload of
//                 the packet: registers high byte first, bits packed lowest first
//   msg.area      'coils', 'discrete_inputs', 'holding_registers' or 'input_registers'
//   msg.address   the address of the first value, from 0
//   msg.unit      the unit id, for a packet of format v1; or
//   msg.memoryId  the memory id, for a packet of format crc; msg.crc = 'none' omits the CRC
//   msg.count     the number of bits in a Buffer
//
// Invalid values are refused with an error. They are never truncated, rounded or converted.

const AREAS = ['coils', 'discrete_inputs', 'holding_registers', 'input_registers'];

function refuse(text) {
    throw new RangeError(text);
}

function integer(name, value, least) {
    if (!Number.isInteger(value) || value < least || value > 65535) {
        refuse(`${name} is ${shown(value)}, allowed: ${least} to 65535`);
    }
    return value;
}

function shown(value) {
    const text = typeof value === 'object' ? JSON.stringify(value) : String(value);
    return value === undefined ? 'missing' : text.slice(0, 40);
}

function packed(values, bits) {
    const payload = Buffer.alloc(bits ? Math.ceil(values.length / 8) : values.length * 2);
    for (let i = 0; i < values.length; i += 1) {
        const value = bits && typeof values[i] === 'boolean' ? Number(values[i]) : values[i];
        if (!Number.isInteger(value) || value < 0 || value > (bits ? 1 : 65535)) {
            const allowed = bits ? '0, 1, false, true' : 'integers 0 to 65535';
            refuse(`payload[${i}] is ${shown(values[i])}, allowed: ${allowed}`);
        }
        if (bits) {
            payload[i >> 3] |= value << (i & 7);
        } else {
            payload.writeUInt16BE(value, i * 2);
        }
    }
    return payload;
}

function crc32(bytes) {
    let crc = 0xffffffff;
    for (const byte of bytes) {
        crc = CRC_TABLE[(crc ^ byte) & 0xff] ^ (crc >>> 8);
    }
    return (crc ^ 0xffffffff) >>> 0;
}

const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
    let crc = byte;
    for (let bit = 0; bit < 8; bit += 1) {
        crc = crc & 1 ? (crc >>> 1) ^ 0xedb88320 : crc >>> 1;
    }
    return crc;
});

function packet() {
    const area = AREAS.indexOf(msg.area) + 1;
    if (area === 0) {
        refuse(`area is ${shown(msg.area)}, allowed: ${AREAS.join(', ')}`);
    }
    const bits = area <= 2;
    const v1 = msg.unit !== undefined;
    if (v1 === (msg.memoryId !== undefined)) {
        refuse('give either unit (format v1) or memoryId (format crc)');
    }
    if (msg.crc !== undefined && (v1 || !['required', 'none'].includes(msg.crc))) {
        refuse(`crc is ${shown(msg.crc)}, allowed: 'required' or 'none' with memoryId`);
    }
    const target = v1 ? integer('unit', msg.unit, 0) : integer('memoryId', msg.memoryId, 0);
    const address = integer('address', msg.address, 0);

    const ready = Buffer.isBuffer(msg.payload);
    if (!ready && !Array.isArray(msg.payload)) {
        refuse(`payload is ${shown(msg.payload)}, allowed: an array and a Buffer`);
    }
    let count = msg.payload.length;
    if (ready) {
        count = bits ? integer('count', msg.count, 1) : msg.payload.length / 2;
        if (bits && msg.payload.length !== Math.ceil(count / 8)) {
            refuse(`${count} bits are ${Math.ceil(count / 8)} bytes, payload has ${msg.payload.length}`);
        }
    }
    integer('the number of values', count, 1);
    if (address + count > 65536) {
        refuse(`${count} values from address ${address}, the last address is 65535`);
    }
    const payload = ready ? msg.payload : packed(msg.payload, bits);

    const fields = Buffer.alloc(6);
    fields.writeUInt16BE(target, 0);
    fields.writeUInt16BE(address, 2);
    fields.writeUInt16BE(count, 4);
    if (v1) {
        return Buffer.concat([Buffer.from([0x52, 0x49, 1, area]), fields, payload]);
    }
    const body = Buffer.concat([Buffer.from([0x52, 0x49, 1, 0, area, 0]), fields, payload]);
    if (msg.crc === 'none') {
        return body;
    }
    const trailer = Buffer.alloc(4);
    trailer.writeUInt32BE(crc32(body), 0);
    return Buffer.concat([body, trailer]);
}

try {
    msg.payload = packet();
} catch (error) {
    node.error(`Raw Ingest: ${error.message}`, msg);
    return null;
}
delete msg.rawIngest;
return msg;
