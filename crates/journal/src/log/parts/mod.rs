//! The parts of a node: each has its own state, and a session passes on what one of them finds out.

pub(crate) mod applier;
pub(crate) mod background;
pub(crate) mod comparer;
pub(crate) mod continuity;
pub(crate) mod in_flight;
pub(crate) mod lost_messages;
pub(crate) mod node;
pub(crate) mod note;
pub(crate) mod rejoin;
pub(crate) mod sender;
pub(crate) mod session;
pub(crate) mod session_start;
pub(crate) mod snapshotter;
pub(crate) mod thread;
