//! Links: one connection or one serial line each, shared by all that send requests to the devices behind it.
//!
//! The poller asks by [`Link::call`], listeners through a [`Route`], event loops by
//! [`SharedLink::call`]. Over Modbus TCP, several requests
//! can be in flight, if the settings allow it. Other transports carry one request at a time, in a
//! thread of their own. Requests that wait for a place are served in a fair order ([`scheduling::queue`]).
//!
//! After a failed connect, polls fail immediately until a pause is over ([`limits::connect_pause`]), and requests of
//! clients while a circuit breaker is open ([`limits::circuit_breaker`]).
//! `Connection`, in `holdfast_protocol`, decides when a connection ends. The next request opens a new one.

mod caller;
mod fault;
pub(crate) mod limits;
mod local_link;
mod route;
pub(crate) mod scheduling;
pub(crate) mod sockets;

pub use caller::{Called, Caller};
pub use fault::Fault;
pub(crate) use fault::{confirmation, exception, exception_code, exception_in, fault};
pub(crate) use limits::circuit_breaker::Down;
pub use limits::lease_fence::{Fence, Stage};
pub(crate) use limits::lease_fence::{Pass, submit_under};
pub(crate) use limits::permit::{Permit, Wanted};
pub(crate) use limits::standstill;
pub(crate) use local_link::Link;
pub(crate) use route::{Asker, Call, Receiver};
pub use route::{LinkCounters, LinkSettings, Route, SharedLink, Withdrawal};
pub use scheduling::in_flight::InFlight;
pub(crate) use scheduling::pending_reply::{PendingReply, Reply, ReplyTo, pending_reply};
pub(crate) use scheduling::queue::{Priority, new_source};
pub(crate) use scheduling::request_loop::serve;
pub(crate) use sockets::connect::dial;
pub(crate) use sockets::handshake::agree;
