// modbus-serial as a client and a server: TCP, RTU over TCP, UDP, and serial lines in both modes.
'use strict';

const net = require('net');
const { once } = require('events');
const Client = require('modbus-serial');
const { Answered, answerAll } = require('./json_lines.cjs');

const { ServerTCP, ServerSerial } = Client;
const TIMEOUT = 10000;
const LINE = { baudRate: 19200 };

const CONNECT = {
    'tcp:': (client, url) => client.connectTCP(url.hostname, { port: Number(url.port) }),
    'udp:': (client, url) => client.connectUDP(url.hostname, { port: Number(url.port) }),
    'rtu+tcp:': (client, url) =>
        client.connectTelnet(url.hostname, { port: Number(url.port) }),
    'rtu:': (client, url) => client.connectRTUBuffered(url.pathname, LINE),
    'ascii:': (client, url) => client.connectAsciiSerial(url.pathname, LINE),
};

async function runClient(url, unit) {
    const client = new Client();
    await CONNECT[url.protocol](client, url);
    client.setID(unit);
    client.setTimeout(TIMEOUT);
    await answerAll(async (operation) => {
        try {
            return await call(client, unit, operation);
        } catch (error) {
            if (error.modbusCode !== undefined) {
                throw new Answered(error.modbusCode);
            }
            throw error;
        }
    });
}

async function call(client, unit, operation) {
    const { address, count, value, values } = operation;
    const bits = ({ data }) => data.slice(0, count).map(Number);
    switch (operation.call) {
    case 'read_coils': return bits(await client.readCoils(address, count));
    case 'read_discrete_inputs': return bits(await client.readDiscreteInputs(address, count));
    case 'read_holding_registers': return (await client.readHoldingRegisters(address, count)).data;
    case 'read_input_registers': return (await client.readInputRegisters(address, count)).data;
    case 'write_coil': await client.writeCoil(address, value === 1); return null;
    case 'write_register': await client.writeRegister(address, value); return null;
    case 'write_coils': await client.writeCoils(address, values.map(Boolean)); return null;
    case 'write_registers': await client.writeRegisters(address, values); return null;
    case 'mask_write':
        await client.maskWriteRegister(address, operation.and, operation.or);
        return null;
    case 'read_write':
        return new Promise((resolve, reject) => client.writeFC23(unit, operation.read_address,
            count, address, values.length, values,
            (error, reply) => (error ? reject(error) : resolve(reply.data))));
    case 'identify':
        return (await client.readDeviceIdentification(operation.code, operation.object)).data;
    default: throw new Error(`no call ${operation.call}`);
    }
}

/** The areas. An address that is not there is an exception. */
function vector() {
    const fill = (value) => Array.from({ length: 1000 }, (_, at) => value(at));
    const coils = fill(() => false);
    const discrete = fill((at) => at % 3 === 0);
    const holding = fill(() => 0);
    const input = fill((at) => at);
    const there = (at) => {
        if (at >= 1000) {
            throw Object.assign(new Error('no such address'), { modbusErrorCode: 2 });
        }
        return at;
    };
    return {
        getCoil: (at) => coils[there(at)],
        getDiscreteInput: (at) => discrete[there(at)],
        getHoldingRegister: (at) => holding[there(at)],
        getInputRegister: (at) => input[there(at)],
        setCoil: (at, value) => { coils[there(at)] = value; },
        setRegister: (at, value) => { holding[there(at)] = value; },
        setRegisterArray: (at, values) => {
            there(at + values.length - 1);
            values.forEach((value, index) => { holding[at + index] = value; });
        },
        readDeviceIdentification: () => ({ 0: 'Acme', 1: 'P1', 2: '1.2' }),
    };
}

/** A port that was free: for its server, 0 is not a port. */
async function freePort() {
    const probe = net.createServer().listen(0, '127.0.0.1');
    await once(probe, 'listening');
    const { port } = probe.address();
    probe.close();
    await once(probe, 'close');
    return port;
}

async function runServer(url) {
    if (url.protocol === 'rtu:') {
        const server = new ServerSerial(vector(), { ...LINE, path: url.pathname });
        await once(server, 'initialized');
        console.log(0);
    } else {
        const port = await freePort();
        const server = new ServerTCP(vector(), { host: '127.0.0.1', port });
        await once(server, 'initialized');
        console.log(port);
    }
}

const [role, address, unit] = process.argv.slice(2);
const url = new URL(address);
(role === 'client' ? runClient(url, Number(unit)) : runServer(url));
