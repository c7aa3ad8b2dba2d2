//! Heartbeats of native threads, as Python has them.

use holdfast_engine::Heartbeat;

/// The name of the thread, seconds since its last beat, and the system's number of it.
pub fn to_python(heartbeat: &Heartbeat) -> (String, f64, Option<u32>) {
    (heartbeat.thread().to_owned(), heartbeat.age().as_secs_f64(), heartbeat.thread_id())
}
