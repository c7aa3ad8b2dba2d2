//! What async-nats needs of regex, without tables of Unicode.

pub use regex_lite::Regex;
