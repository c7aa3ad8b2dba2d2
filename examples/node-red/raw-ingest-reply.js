// Interprets the reply of a receiver; for a function node with two outputs: written, not written.

const reply = Buffer.isBuffer(msg.payload) && msg.payload.length === 1 ? msg.payload[0] : null;
if (reply === 0) {
    msg.payload = 'written';
    return [msg, null];
}
msg.payload = reply === 1 ? 'refused' : 'not a reply of Raw Ingest';
node.error(`Raw Ingest: ${msg.payload}`, msg);
return [null, msg];
