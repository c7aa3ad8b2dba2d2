//! Links: one connection or one serial line each, shared by all that send requests to the devices behind it.
//!
//! The poller asks by [`Link::call`], listeners through a [`Route`], event loops by
//! [`SharedLink::call`]. Over Modbus TCP, several requests
//! can be in flight, if the settings allow it. Other transports carry one request at a time, in a
//! thread of their own. Requests that wait for a place are served in a fair order ([`queue`]).
//!
//! After a failed connect, requests fail immediately until the backoff is over. `Connection`, in
//! `holdfast_protocol`, decides when a connection ends. The next request opens a new one.

mod access;
mod blocking;
mod caller;
mod circuit_breaker;
mod dialing;
mod fault;
mod fence;
mod flood;
mod handshake;
mod order;
mod pace;
mod pending_reply;
mod permit;
mod queue;
mod route;
mod serving;
mod shared_reads;
mod tcp;

pub(crate) use access::Link;
pub use caller::{Called, Caller};
pub(crate) use dialing::dial;
pub use fault::Fault;
pub(crate) use fault::exception;
pub(crate) use fence::Pass;
pub use fence::{Fence, Stage};
pub(crate) use handshake::agree;
pub use pace::InFlight;
pub(crate) use pending_reply::{PendingReply, Reply, ReplyTo, pending_reply};
pub(crate) use permit::Permit;
pub(crate) use queue::{Priority, source};
pub(crate) use route::{Asker, Call};
pub use route::{LinkCounters, LinkSettings, Route, SharedLink};
pub(crate) use serving::serve;
