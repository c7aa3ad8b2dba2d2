// jsmodbus as a client and a server, over TCP and on a serial line in RTU mode.
'use strict';

const net = require('net');
const { once } = require('events');
const modbus = require('jsmodbus');
const { SerialPort } = require('serialport');
const { Answered, answerAll } = require('./json_lines.cjs');

const TIMEOUT = 10000;

function opened(url) {
    if (url.protocol === 'rtu:') {
        return [new SerialPort({ path: url.pathname, baudRate: 19200 }), 'open'];
    }
    return [net.connect({ host: url.hostname, port: Number(url.port) }), 'connect'];
}

async function runClient(url, unit) {
    const [socket, event] = opened(url);
    const kind = url.protocol === 'rtu:' ? modbus.client.RTU : modbus.client.TCP;
    const client = new kind(socket, unit, TIMEOUT);
    await once(socket, event);
    await answerAll(async (operation) => {
        try {
            return await call(client, operation);
        } catch (error) {
            if (error.err === 'ModbusException') {
                throw new Answered(error.response.body.code);
            }
            throw error;
        }
    });
}

async function call(client, operation) {
    const { address, count, value, values } = operation;
    const bits = ({ response }) => response.body.valuesAsArray.slice(0, count).map(Number);
    const words = ({ response }) => Array.from(response.body.valuesAsArray);
    switch (operation.call) {
    case 'read_coils': return bits(await client.readCoils(address, count));
    case 'read_discrete_inputs': return bits(await client.readDiscreteInputs(address, count));
    case 'read_holding_registers': return words(await client.readHoldingRegisters(address, count));
    case 'read_input_registers': return words(await client.readInputRegisters(address, count));
    case 'write_coil': await client.writeSingleCoil(address, value === 1); return null;
    case 'write_register': await client.writeSingleRegister(address, value); return null;
    case 'write_coils': await client.writeMultipleCoils(address, values.map(Boolean)); return null;
    case 'write_registers': await client.writeMultipleRegisters(address, values); return null;
    case 'identify': {
        const { response } = await client.readDeviceIdentification(operation.code, operation.object);
        return Object.fromEntries(response.body.objects.map(({ id, value: text }) =>
            [id, text.toString()]));
    }
    default: throw new Error(`no call ${operation.call}`);
    }
}

/** The areas as the server keeps them: eight bits a byte, two bytes a register. */
function areas() {
    const made = { coils: Buffer.alloc(125), discrete: Buffer.alloc(125),
        holding: Buffer.alloc(2000), input: Buffer.alloc(2000) };
    for (let at = 0; at < 1000; at += 1) {
        made.input.writeUInt16BE(at, at * 2);
        if (at % 3 === 0) {
            made.discrete[at >> 3] |= 1 << (at & 7);
        }
    }
    return made;
}

async function runServer(url) {
    if (url.protocol === 'rtu:') {
        const [port, event] = opened(url);
        new modbus.server.RTU(port, areas());
        await once(port, event);
        console.log(0);
    } else {
        const listener = new net.Server();
        new modbus.server.TCP(listener, areas());
        listener.listen(0, '127.0.0.1');
        await once(listener, 'listening');
        console.log(listener.address().port);
    }
}

const [role, address, unit] = process.argv.slice(2);
const url = new URL(address);
(role === 'client' ? runClient(url, Number(unit)) : runServer(url));
