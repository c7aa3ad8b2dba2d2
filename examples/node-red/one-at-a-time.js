// Passes one packet at a time to the "tcp request" node; for a function node.
//
// A Raw Ingest connection carries one packet. "tcp request" sends all messages before the reply on
// one connection, and the receiver refuses the additional bytes. So packets wait here until the
// outcome of the previous packet arrives: its reply, or the error of "tcp request".

const TIMEOUT = 15000; // Milliseconds to wait for a reply. A receiver's default timeout is 10 seconds.
const MAX_WAITING = 100; // The most packets that can wait.

const state = context.get('state') || { number: 0, sent: null, waiting: [] };
context.set('state', state);

if (msg.rawIngest === undefined) {
    if (state.waiting.length >= MAX_WAITING) {
        node.error(`Raw Ingest: ${MAX_WAITING} packets are already waiting, this packet is dropped`, msg);
        return null;
    }
    state.waiting.push(msg);
} else if (msg.rawIngest === state.number) {
    state.sent = null;
}
if (state.sent !== null && Date.now() - state.sent >= TIMEOUT) {
    node.warn('Raw Ingest: no reply; the packet may have been written');
    state.sent = null;
}
if (state.sent !== null || state.waiting.length === 0) {
    return null;
}
const next = state.waiting.shift();
state.number += 1;
state.sent = Date.now();
next.rawIngest = state.number;
return next;
