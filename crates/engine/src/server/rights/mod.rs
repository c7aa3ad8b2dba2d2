//! What peers may do: rules, functions and ranges.

pub mod functions;
pub mod policy;
pub mod ranges;
