//! Why a device can't be polled, or a write can't be sent.

use std::io;

use thiserror::Error;

use crate::poller::plan::PlanError;

#[derive(Debug, Error)]
pub enum PollerError {
    #[error("device {device}: {error}")]
    Plan { device: String, error: PlanError },
    #[error("device {device}: read {read} does not fit into its destination")]
    Destination { device: String, read: usize },
    #[error("device {device}: the status block does not fit into its memory")]
    Status { device: String },
    #[error("device {device}: read {read} has no items, or goes beyond address 65535")]
    Beyond { device: String, read: usize },
    #[error("device {device}: read {read} has 65536 items, a forwarded packet has at most 65535")]
    Forward { device: String, read: usize },
    #[error("device {device}: forward {forward} moves read {read} beyond address 65535")]
    Offset { device: String, forward: usize, read: usize },
    #[error("device {device}: the status block of forward {forward} ends beyond address 65535")]
    ForwardedStatus { device: String, forward: usize },
    #[error("device {device}: max_{items} is {found}, allowed: 1 to {most}")]
    Limit { device: String, items: &'static str, found: u16, most: u16 },
    #[error("device {device}: the name is already in use")]
    Taken { device: String },
    #[error("device {device}: there is no device of that name")]
    Unknown { device: String },
    #[error("device {device}: function {function} does not write")]
    NoWrite { device: String, function: u8 },
    #[error("the poller has been stopped")]
    Stopped,
    #[error("can't start the poller's thread: {0}")]
    Thread(io::Error),
}
