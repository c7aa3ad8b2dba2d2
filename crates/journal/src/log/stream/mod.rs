//! The stream of a log in JetStream: the connection to it, its messages, and what is stored beside it.

pub(crate) mod connection;
pub(crate) mod message;
pub(crate) mod message_limit;
pub(crate) mod messages;
pub(crate) mod raw_message;
pub(crate) mod store;
