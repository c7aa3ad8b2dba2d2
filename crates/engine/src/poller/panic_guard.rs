//! Catches panics in the tasks of a device, so that other devices continue.

use std::future::poll_fn;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::Pin;
use std::sync::Arc;

use tokio::task::{AbortHandle, spawn_local};

use super::state::DeviceState;

/// A future has panicked. The state it worked on may be inconsistent.
#[derive(Debug)]
pub(super) struct Panicked;

/// Awaits a future and catches its panic.
///
/// The future is pinned elsewhere: this one would have it twice, as an argument and in a pin.
pub(super) async fn catch<F: Future>(mut future: Pin<&mut F>) -> Result<F::Output, Panicked> {
    poll_fn(|context| match catch_unwind(AssertUnwindSafe(|| future.as_mut().poll(context))) {
        Ok(polled) => polled.map(Ok),
        Err(_) => Err(Panicked).into(),
    })
    .await
}

/// Starts a task of a device. If the task panics, the device is in error until it is replaced.
pub(super) fn spawn_guarded(
    task: impl Future<Output = ()> + 'static,
    state: Arc<DeviceState>,
) -> AbortHandle {
    let mut task = Box::pin(task);
    let guarded = async move {
        if catch(task.as_mut()).await.is_err() {
            state.set_broken(true);
        }
    };
    spawn_local(guarded).abort_handle()
}
