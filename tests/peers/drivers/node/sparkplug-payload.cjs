// sparkplug-payload, the library of Eclipse Tahu: decodes payloads to metrics, and encodes metrics.
'use strict';

const Long = require('long');
const sparkplug = require('sparkplug-payload').get('spBv1.0');
const { answerAll } = require('./json_lines.cjs');

/** A value for JSON: integers of 64 bits as text, bytes as hex. */
function plain(value) {
    if (Long.isLong(value)) {
        return value.toString();
    }
    return value instanceof Uint8Array ? Buffer.from(value).toString('hex') : value;
}

function decoded(payload) {
    const { metrics } = sparkplug.decodePayload(Buffer.from(payload, 'hex'));
    return metrics.map(({ name, type, value }) => ({ name, type, value: plain(value) }));
}

answerAll(async ({ call, payload, metrics }) => {
    switch (call) {
    case 'decode': return decoded(payload);
    case 'encode':
        return Buffer.from(sparkplug.encodePayload({ timestamp: 0, metrics })).toString('hex');
    default: throw new Error(`no call ${call}`);
    }
});
