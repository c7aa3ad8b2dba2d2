//! When a node polls a device that several nodes share: while the fence of its lease is open, and once nothing that
//! the former holder has sent can arrive any more.
//! What it sends without the lease is refused in `link/limits/lease_fence.rs`.

use std::future::pending;
use std::time::Instant;

use tokio::time::sleep_until;

use crate::link::{Fence, Stage};
use crate::poller::device::DeviceSettings;

impl DeviceSettings {
    /// Whether another node may poll the device now, or may still be connected to it.
    pub(super) fn must_stand_by(&self) -> bool {
        self.fence
            .as_deref()
            .is_some_and(|fence| fence.stage() != Stage::Open || self.settles_at(fence).is_some())
    }

    /// Waits until the device may be polled.
    pub(super) async fn admitted(&self) {
        let Some(fence) = &self.fence else { return };
        loop {
            fence.opened().await;
            let Some(at) = self.settles_at(fence) else { return };
            tokio::select! {
                () = fence.ended() => {}
                () = sleep_until(at.into()) => {}
            }
        }
    }

    /// When a device that accepts one connection may be connected to: that of a former holder may last.
    fn settles_at(&self, fence: &Fence) -> Option<Instant> {
        self.release.then(|| fence.settles_at(self.timeout)).flatten()
    }

    /// Waits until no poll may begin.
    pub(super) async fn fenced(&self) {
        match &self.fence {
            None => pending().await,
            Some(fence) => fence.ended().await,
        }
    }
}
