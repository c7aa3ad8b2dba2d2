//! Keeps memories: in a file of this machine ([`mod@file`]), or in a log that several machines share
//! ([`log`]). Both are [`Journal`](holdfast_memory::Journal)s: they carry out the writes to a memory.

#![forbid(unsafe_code)]

pub mod encoding;
pub mod file;
pub mod log;
