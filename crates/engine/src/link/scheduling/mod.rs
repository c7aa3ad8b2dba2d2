//! Which request is next, and which of them share a reply.

pub(crate) mod in_flight;
pub(crate) mod pending_reply;
pub(crate) mod queue;
pub(crate) mod request_loop;
pub(crate) mod shared_reads;
pub(crate) mod write_barrier;
