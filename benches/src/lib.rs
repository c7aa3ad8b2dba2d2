//! What servers are measured with: a closed-loop load, and a loop that shows the limit.
//!
//! Both are one thread over epoll and make one read and one write a connection and wake-up, so that
//! what differs between two runs is the server.

#![forbid(unsafe_code)]
#![cfg(target_os = "linux")]

pub mod bare;
pub mod load;

use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::time::Duration;

use rustix::event::{Timespec, epoll};

/// Something went wrong that makes a measurement worthless.
pub type Failure = Box<dyn std::error::Error>;

/// Level-triggered readiness to read, by number.
struct Poller {
    epoll: OwnedFd,
    events: Vec<epoll::Event>,
}

impl Poller {
    fn new() -> io::Result<Poller> {
        let epoll = epoll::create(epoll::CreateFlags::CLOEXEC)?;
        Ok(Poller { epoll, events: Vec::with_capacity(256) })
    }

    fn add(&self, source: impl AsFd, number: usize) -> io::Result<()> {
        let data = epoll::EventData::new_u64(number as u64);
        Ok(epoll::add(&self.epoll, source, data, epoll::EventFlags::IN)?)
    }

    /// Waits until something can be read, and says what: nothing, when `patience` ends first.
    fn wait(
        &mut self,
        patience: Option<Duration>,
    ) -> io::Result<impl ExactSizeIterator<Item = usize> + '_> {
        self.events.clear();
        let patience = patience.map(|patience| Timespec {
            tv_sec: patience.as_secs().try_into().unwrap_or(i64::MAX),
            tv_nsec: patience.subsec_nanos().into(),
        });
        loop {
            let room = rustix::buffer::spare_capacity(&mut self.events);
            match epoll::wait(&self.epoll, room, patience.as_ref()) {
                Ok(_) => break,
                Err(rustix::io::Errno::INTR) => {}
                Err(error) => return Err(error.into()),
            }
        }
        Ok(self.events.iter().map(|event| event.data.u64() as usize))
    }
}
