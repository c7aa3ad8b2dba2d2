//! The tasks of one device: polls, forwards, writes, and what a reload leaves of them.

use std::cell::RefCell;
use std::future;
use std::mem;
use std::rc::Rc;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use holdfast_protocol::pdu::EncodedRequest;
use tokio::sync::watch;
use tokio::task::{AbortHandle, spawn_local};

use super::links::UsedLink;
use super::polled_device::Polled;
use crate::client::SendMoment;
use crate::link::{Fault, Fence, Link, Permit, Priority, Stage, Wanted, fault, standstill};
use crate::poller::destination::{ReadSettings, mirrors};
use crate::poller::device::{Device, DeviceSettings, Inbox, Planned};
use crate::poller::forwarding::{Forward, ForwardCounters, ForwardSettings};
use crate::poller::panic_guard::spawn_guarded;
use crate::poller::results::{Results, Written};
use crate::poller::state::DeviceState;
use crate::poller::turn::Turn;
use crate::poller::write_through::PassedWrite;

/// A device as the thread of the poller sees it.
pub(super) struct RunningDevice {
    pub(super) link: Rc<UsedLink>,
    turn: Rc<Turn>,
    unit_id: u8,
    timeout: Duration,
    release: bool,
    fence: Option<Arc<Fence>>,
    /// What is read from it now. Writes that are under way look here, and see nothing once their device
    /// is gone.
    reads: Rc<RefCell<Vec<ReadSettings>>>,
    /// Writes that were not sent end with it.
    writes: watch::Sender<()>,
    inbox: Rc<Inbox>,
    device: AbortHandle,
    pub(super) forwards: Vec<RunningForward>,
}

impl Drop for RunningDevice {
    fn drop(&mut self) {
        self.reads.take();
        self.device.abort();
    }
}

impl RunningDevice {
    /// Starts the tasks of a device.
    pub(super) fn start(
        planned: Planned,
        polled: Polled,
        link: Rc<UsedLink>,
        phase: Duration,
    ) -> RunningDevice {
        let inbox = Rc::new(Inbox::default());
        let DeviceSettings { unit_id, timeout, release, .. } = planned.settings;
        let fence = planned.settings.fence.clone();
        let reads = Rc::new(RefCell::new(planned.settings.reads.clone()));
        let turn = Rc::new(Turn::default());
        let to = (Rc::clone(&link.0), Rc::clone(&turn));
        let state = Arc::clone(&polled.state);
        let (device, forwards) = made(planned, polled, to, Vec::new());
        let device = spawn_guarded(device.run(phase, Rc::clone(&inbox)), state);
        let writes = watch::Sender::default();
        RunningDevice {
            link,
            turn,
            unit_id,
            timeout,
            release,
            fence,
            reads,
            writes,
            inbox,
            device,
            forwards,
        }
    }

    /// Whether the task of the device has panicked. It does not end otherwise.
    pub(super) fn has_panicked(&self) -> bool {
        self.device.is_finished()
    }

    pub(super) fn replace(
        &mut self,
        planned: Planned,
        polled: Polled,
        link: Rc<UsedLink>,
        at_once: bool,
    ) {
        let settings = &planned.settings;
        let is_other = !Rc::ptr_eq(&self.link, &link) || self.unit_id != settings.unit_id;
        if is_other || mirrors(&self.reads.borrow()).ne(mirrors(&settings.reads)) {
            // Packets say where values go, and not where they were read.
            self.forwards.iter().for_each(|running| running.forward.withdraw());
        }
        if is_other {
            // Another device: writes that are under way are not its own.
            self.reads.take();
            self.reads = Rc::default();
            self.writes = watch::Sender::default();
        }
        self.reads.borrow_mut().clone_from(&settings.reads);
        (self.unit_id, self.timeout) = (settings.unit_id, settings.timeout);
        (self.release, self.link) = (settings.release, link);
        self.fence.clone_from(&settings.fence);
        let before = mem::take(&mut self.forwards);
        let to = (Rc::clone(&self.link.0), Rc::clone(&self.turn));
        let (device, forwards) = made(planned, polled, to, before);
        self.forwards = forwards;
        if at_once {
            device.want_soon();
        }
        self.inbox.replace_with(device);
    }

    /// Of a write: it is sent only while its device is there.
    fn permit(&self, until: Option<Instant>) -> Permit {
        let device = self.writes.subscribe();
        let wanted: Wanted = Arc::new(move |_| device.has_changed().is_ok());
        Permit { fence: self.fence.clone(), until, wanted: Some(wanted), ..Permit::default() }
    }

    /// Sends a write between two reads, as soon as possible, unless its receiver withdraws it before. One that
    /// was sent has its result, even if the device is removed.
    pub(super) fn write(
        &self,
        ticket: u64,
        request: Box<EncodedRequest>,
        (queued, until): (Duration, Option<Instant>),
        to: Arc<Results>,
    ) {
        let (link, turn) = (Rc::clone(&self.link.0), Rc::clone(&self.turn));
        let inbox = Rc::clone(&self.inbox);
        let RunningDevice { unit_id, timeout, release, .. } = *self;
        let until = until.map(|until| until + timeout);
        // Decided once, by the thread of the link or by the end of the device.
        let fate = Arc::new(OnceLock::new());
        let mut device = self.writes.subscribe();
        let (decided, receiver) = (Arc::clone(&fate), Arc::clone(&to));
        let permit = self.permit(until).and(standstill::none_since(queued));
        let permit = permit.and(Arc::new(move |moment| {
            !receiver.has_withdrawn()
                && match moment {
                    SendMoment::Waiting => true,
                    SendMoment::Sending => *decided.get_or_init(|| Fate::Sent) == Fate::Sent,
                }
        }));
        let withdrawn = async move {
            let _ends = device.changed().await;
            if *fate.get_or_init(|| Fate::Withdrawn) == Fate::Sent {
                future::pending::<()>().await;
            }
        };
        let sending = async move {
            let fence = permit.fence.as_ref();
            let taken = permit.in_time(turn.take_to_write(fence, timeout)).await;
            let taken = taken.ok_or(Fault::Expired)?.ok_or(Fault::Standby)?;
            let answer = link.call(unit_id, &request, timeout, Priority::Urgent, &permit).await;
            drop(taken);
            if release || stands_by(fence) {
                link.release();
            }
            if answer.is_ok() {
                inbox.wake();
            }
            answer.map(drop).map_err(|error| fault(&error))
        };
        spawn_local(async move {
            let outcome = tokio::select! {
                biased;
                () = withdrawn => Err(Fault::Withdrawn),
                outcome = sending => outcome,
            };
            to.push_write(Written { ticket, outcome });
        });
    }

    /// Carries out a write of a Modbus client, between two reads.
    pub(super) fn pass(&self, write: PassedWrite) {
        let (link, turn) = (Rc::clone(&self.link.0), Rc::clone(&self.turn));
        let (inbox, reads) = (Rc::clone(&self.inbox), Rc::clone(&self.reads));
        let RunningDevice { unit_id, timeout, release, .. } = *self;
        let permit = self.permit(None);
        spawn_local(async move {
            let fence = permit.fence.as_ref();
            let Some(taken) = turn.take_to_write(fence, timeout).await else {
                return write.refuse();
            };
            let changes = write.carry_out((&link, unit_id, &reads), timeout, &permit).await;
            if !changes.is_empty() {
                inbox.wake();
            }
            changes.into_iter().for_each(|change| turn.note(change));
            drop(taken);
            if release || stands_by(fence) {
                link.release();
            }
        });
    }
}

/// What came first: that a write was sent, or that its device was removed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fate {
    Sent,
    Withdrawn,
}

/// Whether a device stands by, so that a write leaves no connection behind.
fn stands_by(fence: Option<&Arc<Fence>>) -> bool {
    fence.is_some_and(|fence| fence.stage() != Stage::Open)
}

/// Creates a device, and starts the tasks that forward its reads. Those of the device before that have
/// the same receiver and fence go on: they send what is waiting, and what the current poll reads.
fn made(
    planned: Planned,
    polled: Polled,
    to: (Rc<Link>, Rc<Turn>),
    mut before: Vec<RunningForward>,
) -> (Device, Vec<RunningForward>) {
    polled.state.set_broken(false);
    polled.state.set_strays(to.0.strays());
    let settings = &planned.settings;
    debug_assert_eq!(settings.forward.len(), polled.forwards.len());
    let fence = settings.fence.as_ref();
    let receivers = settings.forward.iter().cloned().zip(polled.forwards);
    let running: Vec<RunningForward> = receivers
        .map(|(settings, counters)| {
            match before.iter().position(|old| old.goes_on(&counters, fence)) {
                Some(at) => before.swap_remove(at),
                None => RunningForward::start(settings, counters, fence.cloned(), &polled.state),
            }
        })
        .collect();
    let forwards = running.iter().map(|running| Rc::clone(&running.forward)).collect();
    (Device::new(planned, polled.state, to, forwards), running)
}
/// A receiver and the task that sends to it.
pub(super) struct RunningForward {
    pub(super) forward: Rc<Forward>,
    pub(super) task: AbortHandle,
}

impl RunningForward {
    fn start(
        settings: ForwardSettings,
        counters: Arc<ForwardCounters>,
        fence: Option<Arc<Fence>>,
        state: &Arc<DeviceState>,
    ) -> RunningForward {
        let forward = Forward::new(settings, counters, fence);
        let task = spawn_guarded(Rc::clone(&forward).run(), Arc::clone(state));
        RunningForward { forward, task }
    }

    /// Whether it has these counters and this fence, and has not panicked.
    fn goes_on(&self, counters: &Arc<ForwardCounters>, fence: Option<&Arc<Fence>>) -> bool {
        Arc::ptr_eq(&self.forward.counters, counters)
            && self.forward.is_behind(fence)
            && !self.task.is_finished()
    }
}

impl Drop for RunningForward {
    fn drop(&mut self) {
        self.task.abort();
    }
}
