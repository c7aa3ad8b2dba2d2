//! What peers may do: rules, functions and ranges.

pub mod functions;
pub mod peer_rights;
pub mod policy;
pub mod ranges;
pub mod rule;
pub(crate) mod sources;
