// Lets one packet at a time to the "tcp request" node; for a function node.
//
// A Raw Ingest connection carries one packet. "tcp request" puts all that comes before the reply on
// one connection, and then the receiver refuses what is too much. So packets wait here until what
// became of the one before comes back: its reply, or the error of "tcp request".

const PATIENCE = 15000; // Milliseconds for a reply. A receiver gives up after 10 seconds by default.
const MOST = 100; // Packets that may wait.

const state = context.get('state') || { number: 0, sent: null, waiting: [] };
context.set('state', state);

if (msg.rawIngest === undefined) {
    if (state.waiting.length >= MOST) {
        node.error(`Raw Ingest: ${MOST} packets wait already, this one is dropped`, msg);
        return null;
    }
    state.waiting.push(msg);
} else if (msg.rawIngest === state.number) {
    state.sent = null;
}
if (state.sent !== null && Date.now() - state.sent >= PATIENCE) {
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
