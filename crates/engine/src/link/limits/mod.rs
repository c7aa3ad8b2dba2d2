//! When a link takes or sends nothing: a full queue, failed connects, units that are silent, floods, leases,
//! deadlines and standstills.

pub(crate) mod circuit_breaker;
pub(crate) mod connect_pause;
pub(crate) mod flood;
pub(crate) mod lease_fence;
pub(crate) mod permit;
pub(crate) mod queue_share;
pub(crate) mod standstill;
