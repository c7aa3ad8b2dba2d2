//! A log of writes that several machines share, in NATS JetStream.
