//! One device: its schedule, plan and results.
//!
//! A poll is due by its schedule ([`super::schedule`]); a silent unit is polled less and less often,
//! with one request, until it answers ([`super::poll_pause`]). A poll begins after the block at which the
//! previous one failed, so that a block that is never answered does not block the others.
//!
//! When settings change, a new device replaces the old one between two polls. It keeps the schedule
//! and what the old one learned.

use std::cell::{Cell, RefCell, RefMut};
use std::collections::HashMap;
use std::convert::Infallible;
use std::future::pending;
use std::num::NonZeroU16;
use std::pin::pin;
use std::rc::Rc;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use holdfast_memory::{Access, Area, Memory, Outcome, Refusal, Write};
use holdfast_protocol::client::InvalidResponse;
use holdfast_protocol::pdu::{EncodedRequest, Range, Request, ResponseError};
use holdfast_runtime::Retry;
use tokio::sync::Notify;
use tokio::time::{Instant, sleep, sleep_until};

use super::cost::Samples;
use super::destination::{Destination, ReadSettings, WriteOutcomes, mirrors};
use super::forwarding::{Forward, ForwardSettings};
use super::panic_guard::{Panicked, catch};
use super::plan::{self, BITS_PER_REGISTER, Block, Field, PlanError, PlanLimits, Strategy};
use super::poll_pause::PollPause;
use super::remembered_refusals::{Learned, Unreadable};
use super::results::{BlockResult, Poll, Results};
use super::schedule::Schedule;
use super::state::DeviceState;
use super::status::{STATUS_INTERVAL, StatusSettings};
use super::turn::Turn;
use crate::client::{ClientError, Endpoint};
use crate::link::{Fault, Fence, InFlight, Link, Permit, Priority, fault, submit_under};

/// Settings of a device.
#[derive(Debug, Clone)]
pub struct DeviceSettings {
    pub name: String,
    pub endpoint: Endpoint,
    /// Requests in flight at its address, over TCP. Of devices that share an address, the first one
    /// decides this, `retry` and [`Endpoint::tolerance`].
    pub in_flight: InFlight,
    /// When it is tried again if it cannot be reached or does not answer.
    pub retry: Retry,
    pub unit_id: u8,
    /// The time between polls; 0 polls without a pause.
    pub interval: Duration,
    pub timeout: Duration,
    pub reads: Vec<ReadSettings>,
    pub limits: PlanLimits,
    pub strategy: Strategy,
    /// Whether the costs of [`Strategy::Cost`] are initial estimates, replaced by measurements.
    pub measured: bool,
    pub forward: Vec<ForwardSettings>,
    pub status: Option<StatusSettings>,
    /// The first poll begins within this time. Devices are spread over it.
    pub start_within: Duration,
    /// A queue that also receives the polls.
    pub report: Option<Arc<Results>>,
    /// The name of the device in these polls, if it has another one there.
    pub reported_as: Option<String>,
    /// Whether the connection is closed after each poll, for devices that accept only one.
    pub release: bool,
    /// Until when the device may be used. Devices of one link have the same, or none.
    pub fence: Option<Arc<Fence>>,
}

#[cfg(test)]
impl DeviceSettings {
    /// Nothing but these reads, each on its own.
    pub(super) fn for_tests(endpoint: Endpoint, reads: Vec<ReadSettings>) -> DeviceSettings {
        DeviceSettings {
            name: "meter".into(),
            endpoint,
            in_flight: InFlight::Fixed(1),
            retry: Retry::default(),
            unit_id: 1,
            interval: Duration::from_secs(1),
            timeout: Duration::from_secs(1),
            reads,
            limits: PlanLimits::default(),
            strategy: Strategy::Gap { max_gap: 0 },
            measured: false,
            forward: Vec::new(),
            status: None,
            start_within: Duration::ZERO,
            report: None,
            reported_as: None,
            release: false,
            fence: None,
        }
    }
}

/// A running device.
pub(super) struct Device {
    settings: DeviceSettings,
    state: Arc<DeviceState>,
    link: Rc<Link>,
    turn: Rc<Turn>,
    forwards: Vec<Rc<Forward>>,
    /// The parts of reads. Each fits into one request.
    pub(super) fields: Vec<Field>,
    /// For each field, the index of its read, and its offset in it, in items.
    parts: Vec<(usize, u32)>,
    /// For each read, if it goes into a memory.
    outcomes: Vec<Option<Arc<WriteOutcomes>>>,
    reported_as: Arc<str>,
    learned: RefCell<Learned>,
    /// `None` while the device has no plan. The state has the error.
    plan: RefCell<Option<Rc<Vec<Block>>>>,
    /// The index of the first block of the next poll.
    first: Cell<usize>,
    strategy: Cell<Strategy>,
    samples: Cell<Samples>,
    poll_pause: PollPause,
    schedule: Schedule,
}

/// Messages to a device that waits for its next poll.
#[derive(Default)]
pub(super) struct Inbox {
    successor: RefCell<Option<Device>>,
    awake: Cell<bool>,
    arrived: Notify,
}

/// What [`Inbox::next`] returns.
enum Message {
    /// A new device replaces this one.
    Successor(Box<Device>),
    /// The device has answered a write.
    Awake,
}

impl Inbox {
    /// A new device takes the place of this one.
    pub(super) fn replace_with(&self, successor: Device) {
        let earlier = self.successor.take();
        if earlier.is_some_and(|earlier| earlier.schedule.is_wanted_soon()) {
            successor.want_soon();
        }
        self.successor.replace(Some(successor));
        self.arrived.notify_one();
    }

    pub(super) fn wake(&self) {
        self.awake.set(true);
        self.arrived.notify_one();
    }

    /// Waits for a successor whose values have another source or place: those of this device would replace
    /// what belongs to another one now.
    async fn until_moved(&self, device: &Device) {
        while !self.successor.borrow().as_ref().is_some_and(|next| device.is_moved(next)) {
            self.arrived.notified().await;
        }
    }

    async fn next(&self) -> Message {
        loop {
            if let Some(successor) = self.successor.take() {
                return Message::Successor(Box::new(successor));
            }
            if self.awake.take() {
                return Message::Awake;
            }
            self.arrived.notified().await;
        }
    }
}

/// Settings of a device, with its first plan.
#[derive(Debug)]
pub(super) struct Planned {
    pub(super) settings: DeviceSettings,
    /// The parts of reads. Each fits into one request.
    fields: Vec<Field>,
    /// For each field, the index of its read, and its offset in it, in items.
    parts: Vec<(usize, u32)>,
    plan: Vec<Block>,
}

impl Planned {
    /// # Errors
    /// [`PlanError`] for a read that cannot be planned.
    pub(super) fn new(settings: DeviceSettings) -> Result<Planned, PlanError> {
        let (fields, parts) = parted(&settings.reads, &settings.limits);
        let plan = plan::plan(&fields, &settings.limits, settings.strategy)?;
        Ok(Planned { settings, fields, parts, plan })
    }
}

/// Splits reads into fields, each no longer than a request. Returns for each field the index of its
/// read, and its offset in it.
fn parted(reads: &[ReadSettings], limits: &PlanLimits) -> (Vec<Field>, Vec<(usize, u32)>) {
    let (mut fields, mut parts) = (Vec::new(), Vec::new());
    for (index, read) in reads.iter().enumerate() {
        let most = limits.most(read.area);
        let mut at = 0;
        while at < read.count {
            // The plan reports a limit of 0.
            let count = u32::from(most.max(1)).min(read.count - at);
            let address = (u32::from(read.address) + at) as u16;
            fields.push(Field { area: read.area, address, count: count as u16 });
            parts.push((index, at));
            at += count;
        }
    }
    (fields, parts)
}

impl Device {
    pub(super) fn new(
        Planned { settings, fields, parts, plan }: Planned,
        state: Arc<DeviceState>,
        (link, turn): (Rc<Link>, Rc<Turn>),
        forwards: Vec<Rc<Forward>>,
    ) -> Device {
        let outcomes = settings.reads.iter().map(|read| read.into.as_ref().map(|_| Arc::default()));
        let device = Device {
            fields,
            parts,
            outcomes: outcomes.collect(),
            reported_as: settings.reported_as.as_ref().unwrap_or(&settings.name).as_str().into(),
            learned: RefCell::default(),
            plan: RefCell::default(),
            first: Cell::new(0),
            strategy: Cell::new(settings.strategy),
            samples: Cell::default(),
            poll_pause: PollPause::default(),
            schedule: Schedule::new(settings.interval),
            settings,
            state,
            link,
            turn,
            forwards,
        };
        device.adopt(Ok(plan));
        device
    }

    /// Polls forever, first after `phase`, and keeps the status block up to date.
    pub(super) async fn run(mut self, phase: Duration, inbox: Rc<Inbox>) {
        self.schedule.begin_at(Instant::now() + phase);
        self.state.begun();
        loop {
            self.publish_status();
            let polled = catch(pin!(async {
                tokio::select! {
                    successor = self.poll_until_replaced(&inbox) => successor,
                    never = self.publish_status_for_ever() => match never {},
                }
            }))
            .await;
            self = match polled {
                Ok(mut successor) => {
                    successor.take_over(self);
                    *successor
                }
                // Its state may be inconsistent: the new device starts from scratch.
                Err(Panicked) => *self.wait_until_replaced(&inbox).await,
            };
        }
    }

    /// Sends no requests, and keeps the error in the status block, until the device is replaced.
    async fn wait_until_replaced(&self, inbox: &Inbox) -> Box<Device> {
        self.state.set_broken(true);
        // The poll has ended without it.
        self.turn.polls(false);
        loop {
            self.publish_status();
            tokio::select! {
                message = inbox.next() => if let Message::Successor(successor) = message {
                    return successor;
                },
                () = sleep(STATUS_INTERVAL) => {}
            }
        }
    }

    async fn poll_until_replaced(&self, inbox: &Inbox) -> Box<Device> {
        loop {
            if let Some(successor) = self.stand_by(inbox).await {
                return successor;
            }
            tokio::select! {
                biased;
                message = inbox.next() => match message {
                    Message::Successor(successor) => return successor,
                    Message::Awake => {
                        self.wake();
                        continue;
                    }
                },
                () = self.settings.fenced() => continue,
                () = sleep_until(self.schedule.next()) => {}
            }
            let due = self.schedule.begin_poll();
            self.turn.polls(true);
            // In a box: a device takes the memory of a poll only while it polls.
            let poll = Box::pin(self.poll(due));
            let fence = self.settings.fence.as_ref();
            let _pass = fence.map(|fence| fence.pass());
            let closed = async {
                match fence {
                    None => pending().await,
                    Some(fence) => fence.closed().await,
                }
            };
            tokio::select! {
                biased;
                () = closed => {}
                () = inbox.until_moved(self) => {
                    self.turn.polls(false);
                    continue;
                }
                () = poll => {}
            }
            self.turn.polls(false);
            self.publish_status();
            self.state.counters.missed.add_many(self.schedule.skip_until(Instant::now()));
            if let Some(until) = self.poll_pause.after_poll(self.link.retry_at(), self.link.retry) {
                // Polls that are skipped on purpose do not count as missed. An exact pause ends when it
                // ends, and the schedule begins anew then. Without an interval, there is no poll to skip.
                if self.link.retry.jitter && !self.settings.interval.is_zero() {
                    self.schedule.skip_until(until);
                } else {
                    self.schedule.begin_at(until);
                }
            }
            if self.settings.interval.is_zero() {
                tokio::task::yield_now().await;
            }
        }
    }

    /// Waits while another node polls the device. Returns the device that replaces it meanwhile.
    async fn stand_by(&self, inbox: &Inbox) -> Option<Box<Device>> {
        if self.settings.must_stand_by() {
            self.link.release();
            self.state.set_standby(true);
            self.forwards.iter().for_each(|forward| forward.withdraw());
            // Behind the last poll, so that its receiver forgets what that has read.
            self.report_poll(Instant::now(), Gathered::default());
            self.publish_status();
            loop {
                tokio::select! {
                    biased;
                    message = inbox.next() => if let Message::Successor(successor) = message {
                        return Some(successor);
                    },
                    () = self.settings.admitted() => break,
                }
            }
        }
        // The device before this one may have stood by, with another fence.
        if self.state.stands_by() {
            self.state.set_standby(false);
            // What was refused under a former lease fails no poll of this one.
            self.outcomes.iter().flatten().for_each(|outcomes| outcomes.forget());
            self.poll_pause.end();
            self.schedule.begin_now();
        }
        None
    }

    /// Ends the pause of a device that does not answer.
    fn wake(&self) {
        if self.poll_pause.is_delaying() {
            self.poll_pause.end();
            self.schedule.begin_at(Instant::now());
        }
    }

    /// Requests a poll soon, outside the schedule.
    pub(super) fn want_soon(&self) {
        self.schedule.want_soon();
    }

    /// Whether its values have another source or place than those of its successor.
    fn is_moved(&self, successor: &Device) -> bool {
        self.has_other_source(successor)
            || mirrors(&self.settings.reads).ne(mirrors(&successor.settings.reads))
    }

    fn has_other_source(&self, other: &Device) -> bool {
        !Rc::ptr_eq(&self.link, &other.link) || self.settings.unit_id != other.settings.unit_id
    }

    /// Takes over the state of the device before it.
    fn take_over(&mut self, before: Device) {
        self.keep_outcomes(&before);
        let (old, new) = (&before.settings, &self.settings);
        if before.has_other_source(self) {
            return self.schedule.begin_now();
        }
        let is_delaying = before.poll_pause.is_delaying();
        self.schedule.take_over(&before.schedule, is_delaying);
        if before.is_moved(self) && !is_delaying {
            self.schedule.begin_now();
        }
        self.poll_pause = before.poll_pause;
        if old.limits == new.limits {
            self.learned.replace(before.learned.take());
            self.learned().keep(&self.fields);
            self.draw_plan();
        }
    }

    /// A range whose last values were refused before a reload is still without them.
    fn keep_outcomes(&mut self, before: &Device) {
        let of = |device: &Device| {
            let reads = device.settings.reads.iter();
            reads.map(|read| read.into.as_ref().map(Destination::start)).collect::<Vec<_>>()
        };
        let known: HashMap<_, _> = of(before).into_iter().zip(&before.outcomes).collect();
        for (start, outcomes) in of(self).iter().zip(&mut self.outcomes) {
            if let Some(known) = known.get(start) {
                outcomes.clone_from(known);
            }
        }
    }

    async fn publish_status_for_ever(&self) -> Infallible {
        if self.settings.status.is_none()
            && !self.forwards.iter().any(|forward| forward.has_status())
        {
            pending::<()>().await;
        }
        loop {
            sleep(STATUS_INTERVAL).await;
            self.publish_status();
        }
    }

    /// Plans the readable fields within the learned limits.
    pub(super) fn draw_plan(&self) {
        let learned = self.learned.borrow();
        let known: Vec<usize> =
            (0..self.fields.len()).filter(|at| !learned.is_refused(&self.fields[*at])).collect();
        let fields: Vec<Field> = known.iter().map(|at| self.fields[*at]).collect();
        let limits = learned.limits(&self.settings.limits, &fields);
        let mut drawn = plan::plan(&fields, &limits, self.strategy.get());
        if let Ok(plan) = &mut drawn {
            for at in plan.iter_mut().flat_map(|block| &mut block.fields) {
                *at = known[*at];
            }
        }
        self.adopt(drawn.map_err(|error| {
            let (read, _) = self.parts[known[error.field()]];
            format!("read {read}: {error}")
        }));
    }

    /// Uses a plan from now on. Without one, no request is sent.
    fn adopt(&self, drawn: Result<Vec<Block>, String>) {
        let (requests, plan) = match drawn {
            Ok(plan) => (Ok(plan.len()), Some(Rc::new(plan))),
            Err(error) => (Err(error), None),
        };
        self.state.planned(requests);
        *self.plan.borrow_mut() = plan;
    }

    pub(super) fn learned(&self) -> RefMut<'_, Learned> {
        self.learned.borrow_mut()
    }

    /// Plans again when there are enough samples of the cost of a request.
    fn learn(&self) {
        let Strategy::Cost { item, .. } = self.strategy.get() else { return };
        if !self.settings.measured {
            return;
        }
        if let Some((request, item)) = self.samples.get().cost(item) {
            self.strategy.set(Strategy::Cost { request, item });
            self.samples.take();
            self.draw_plan();
        }
    }

    /// Reads every block, and passes on every complete read.
    async fn poll(&self, due: Instant) {
        if self.learned().forget(Instant::now()) {
            self.draw_plan();
        }
        self.learn();
        let mut gathered =
            Gathered { report: self.settings.report.is_some(), ..Gathered::default() };
        let Some(plan) = self.plan.borrow().clone() else {
            return self.leave_out(due, gathered);
        };
        self.state.counters.polls.add();
        let mut fault = None;
        let known = self.learned().unreadable().to_vec();
        let first = self.first.take();
        for index in (0..plan.len()).map(|offset| (first + offset) % plan.len()) {
            match self.read(&plan[index], &mut gathered).await {
                Ok(()) => gathered.answered = true,
                Err(refused) if refused.is_answer() => {
                    gathered.answered = true;
                    fault = Some(refused);
                }
                Err(Fault::Standby) => return,
                Err(other) => {
                    fault = Some(other);
                    // If one request is not answered, the next would not be either.
                    self.first.set(index + 1);
                    break;
                }
            }
        }
        let mut answered = gathered.answered;
        if answered || plan.is_empty() {
            fault = fault.or(self.look_at_unreadable(&known, &mut gathered).await);
            if fault == Some(Fault::Standby) {
                return;
            }
            answered |= fault.is_some_and(Fault::is_answer);
        }
        if self.settings.release {
            self.link.release();
        }
        self.poll_pause.note(fault.is_some() && !answered);
        let is_unstored = self.outcomes.iter().flatten().any(|outcomes| outcomes.is_refused());
        match fault.or(is_unstored.then_some(Fault::Unstored)) {
            None => self.state.good(),
            Some(fault) => self.state.bad(fault),
        }
        self.report_poll(due, gathered);
    }

    /// A poll without a plan: nothing is sent, and every field gets the fault.
    fn leave_out(&self, due: Instant, mut gathered: Gathered) {
        self.state.counters.unplanned.add();
        for field in &self.fields {
            gathered.note(*field, Err(Fault::Unplanned));
        }
        self.state.bad(Fault::Unplanned);
        self.report_poll(due, gathered);
    }

    /// Sends the blocks of a poll to the results. Called after the health of the poll is stored.
    fn report_poll(&self, due: Instant, gathered: Gathered) {
        if let Some(results) = &self.settings.report {
            let (device, blocks) = (Arc::clone(&self.reported_as), gathered.blocks);
            results.push(Poll { device, due: results.counted(due.into_std()), blocks });
        }
    }

    /// Reports unreadable ranges, and tries one of them again from time to time. Returns the fault
    /// of one of them.
    async fn look_at_unreadable(
        &self,
        known: &[Unreadable],
        gathered: &mut Gathered,
    ) -> Option<Fault> {
        let only = self.plan.borrow().as_ref().is_none_or(|plan| plan.is_empty());
        let retried = self.learned().retry(Instant::now(), only);
        let mut fault = None;
        for &Unreadable { range, fault: mut found, .. } in known {
            if retried == Some(range) {
                match self.ask(range).await {
                    Err(fault) => found = fault,
                    Ok(bytes) => {
                        // The next poll reads it with others.
                        gathered.note(range, Ok(bytes));
                        *self.learned() = Learned::default();
                        self.draw_plan();
                        continue;
                    }
                }
            }
            gathered.note(range, Err(found));
            fault = Some(found);
        }
        fault
    }

    async fn read(&self, block: &Block, gathered: &mut Gathered) -> Result<(), Fault> {
        match self.ask(block.range()).await {
            Ok(bytes) => {
                self.take(block, bytes, gathered);
                Ok(())
            }
            Err(fault) if fault.is_illegal() => {
                gathered.answered = true;
                self.search(gathered, block, fault).await
            }
            Err(other) => {
                gathered.note(block.range(), Err(other));
                Err(other)
            }
        }
    }

    /// Passes on the bytes of a block.
    pub(super) fn take(&self, block: &Block, bytes: Vec<u8>, gathered: &mut Gathered) {
        self.spread(block, &bytes, gathered);
        gathered.note(block.range(), Ok(bytes));
    }

    pub(super) async fn ask(&self, range: Field) -> Result<Vec<u8>, Fault> {
        let Field { area, address, count: quantity } = range;
        let request = match area {
            Area::Coils => Range::new(address, quantity).map(Request::ReadCoils),
            Area::DiscreteInputs => Range::new(address, quantity).map(Request::ReadDiscreteInputs),
            Area::HoldingRegisters => {
                Range::new(address, quantity).map(Request::ReadHoldingRegisters)
            }
            Area::InputRegisters => Range::new(address, quantity).map(Request::ReadInputRegisters),
            Area::File(_) => return Err(Fault::Unplanned),
        };
        // The limits of a device are at most those of a request, and every block is within them.
        let request = EncodedRequest::new(&request.expect("a block is a valid request"));
        let _turn = self.turn.take().await;
        let counters = &self.state.counters;
        counters.requests.add();
        let began = Instant::now();
        let priority =
            if self.poll_pause.is_doubtful() { Priority::Doubtful } else { Priority::Usual };
        let DeviceSettings { unit_id, timeout, .. } = &self.settings;
        let fence = self.settings.fence.as_ref();
        let permit = Permit { fence: fence.cloned(), ..Permit::default() };
        let len = area.byte_len(quantity.into());
        let answer = self.link.call(*unit_id, &request, *timeout, priority, &permit).await;
        // A broadcast has no reply, and so no values.
        let invalid = || ClientError::Invalid(InvalidResponse::Pdu(ResponseError::Length)).into();
        let answer = answer
            .map(data)
            .and_then(|bytes| if bytes.len() == len { Ok(bytes) } else { Err(invalid()) });
        // After a stop of the process, a reply may be old, and another node may have read a newer one.
        if fence.is_some_and(|fence| !fence.allows()) {
            return Err(Fault::Standby);
        }
        let answer = answer.map_err(|error| {
            let fault = fault(&error);
            self.state.set_error(error);
            fault
        });
        match &answer {
            Ok(_) => {
                let took = began.elapsed();
                self.state.answered(took);
                let mut samples = self.samples.get();
                let per_item = if area.is_bits() { BITS_PER_REGISTER } else { 1.0 };
                samples.add(f64::from(quantity) / per_item, took.as_secs_f64() * 1e3);
                self.samples.set(samples);
            }
            Err(Fault::Exception(_)) => counters.exceptions.add(),
            Err(Fault::Timeout) => counters.timeouts.add(),
            Err(_) => counters.transport_errors.add(),
        }
        answer
    }

    /// Extracts the fields of a block, and passes on the reads that are complete.
    fn spread(&self, block: &Block, bytes: &[u8], gathered: &mut Gathered) {
        for index in &block.fields {
            let field = self.fields[*index];
            let (read, at) = self.parts[*index];
            let offset = block.offset(&field);
            let settings = &self.settings.reads[read];
            let whole = settings.count == u32::from(field.count);
            if whole && !field.area.is_bits() {
                let end = offset + usize::from(field.count);
                self.deliver_read(read, &bytes[offset * 2..end * 2], settings.now());
            } else if let Some(Partial { bytes, since, .. }) =
                gathered.put(&self.turn, (read, settings), at, field, (bytes, offset))
            {
                self.deliver_read(read, &bytes, since);
            }
        }
    }

    /// `since` is when the values arrived, as [`ReadSettings::now`].
    fn deliver_read(&self, index: usize, bytes: &[u8], since: Option<Duration>) {
        let read = &self.settings.reads[index];
        let (mut area, mut address) = (read.area, read.address);
        if let (Some(into), Some(outcomes)) = (&read.into, &self.outcomes[index]) {
            (area, address) = (into.area, into.address);
            let (age, items) = (into.age.clone().zip(since), read.count);
            let (state, outcomes) = (Arc::clone(&self.state), Arc::clone(outcomes));
            let number = outcomes.begin();
            let ended = move |is_stored| {
                outcomes.end(number, is_stored);
                if !is_stored {
                    return state.counters.unstored.add();
                }
                // After the write, so that the values before it are never taken for fresh.
                age.iter().for_each(|(age, since)| age.renew_since(*since));
                state.count_read(items);
            };
            let write = into.writing(read.count, bytes);
            if self.store(&into.memory, Access::Mirror, write, ended.clone()).is_err() {
                ended(false);
            }
        } else {
            self.state.count_read(read.count);
        }
        if !read.forward {
            return;
        }
        for forward in &self.forwards {
            let count = u16::try_from(read.count).ok().and_then(NonZeroU16::new);
            let count = count.expect("a read that is forwarded fits a packet");
            forward.offer(area, address, count, bytes);
        }
    }

    /// Writes what was read from the device, or its status block. This doesn't wait for the journal of a memory,
    /// because the other devices of the thread would wait too. Unless the write is refused at once, `ended` is
    /// called with whether memory has the values.
    fn store(
        &self,
        memory: &Memory,
        access: Access,
        write: Write<'_>,
        ended: impl FnOnce(bool) + Send + 'static,
    ) -> Result<(), Refusal> {
        if !memory.has_journal() {
            return memory.write(access, write).map(|()| ended(true));
        }
        let done = Box::new(|outcome: Outcome| ended(outcome.is_ok()));
        submit_under(self.settings.fence.as_ref(), memory, access, write, done)
    }

    /// Whether another node writes and forwards what the device holds.
    fn is_without_lease(&self) -> bool {
        let fence = self.settings.fence.as_ref();
        self.state.stands_by() || fence.is_some_and(|fence| !fence.allows())
    }

    fn publish_status(&self) {
        let (status, without_lease) = (self.state.status(), self.is_without_lease());
        if let Some(to) = &self.settings.status
            && !(without_lease && to.memory.is_replicated())
        {
            let state = Arc::clone(&self.state);
            let ended = move |is_stored: bool| {
                if !is_stored {
                    state.counters.unstored.add();
                }
            };
            let written = status
                .write_by(to, |write| self.store(&to.memory, Access::Ingest, write, ended.clone()));
            if written.is_err() {
                ended(false);
            }
        }
        if without_lease {
            return;
        }
        for forward in &self.forwards {
            forward.offer_status(&status);
        }
    }
}

/// The data of the reply to a read: what follows function code and byte count.
fn data(mut pdu: Vec<u8>) -> Vec<u8> {
    pdu.drain(..2.min(pdu.len()));
    pdu
}

/// The data of one poll: reads with several parts, with the number of missing items; all blocks,
/// if they are reported; and whether the device has answered a request.
#[derive(Default)]
pub(super) struct Gathered {
    answered: bool,
    parts: HashMap<usize, Partial>,
    blocks: Vec<BlockResult>,
    report: bool,
}

/// A read of which some items have been read.
struct Partial {
    bytes: Vec<u8>,
    /// When the first of them arrived, as [`ReadSettings::now`].
    since: Option<Duration>,
    /// The number of items that have not been read.
    missing: u32,
    /// How many of the changes of the current poll are in it.
    known_changes: usize,
}

impl Gathered {
    pub(super) fn note(&mut self, range: Field, outcome: Result<Vec<u8>, Fault>) {
        if self.report {
            let Field { area, address, count } = range;
            let time = SystemTime::now();
            self.blocks.push(BlockResult { area, address, count, outcome, time });
        }
    }

    /// Adds a field that has just been read to its read. Returns the read when it is complete.
    fn put(
        &mut self,
        turn: &Turn,
        (read, settings): (usize, &ReadSettings),
        at: u32,
        field: Field,
        (block, offset): (&[u8], usize),
    ) -> Option<Partial> {
        let ReadSettings { area, address, count: all, .. } = *settings;
        let partial = self.parts.entry(read).or_insert_with(|| Partial {
            bytes: vec![0; area.byte_len(all as usize)],
            since: settings.now(),
            missing: all,
            known_changes: 0,
        });
        let whole = &mut partial.bytes;
        // What was written since the fields before were read is not in them.
        partial.known_changes = turn.amend(partial.known_changes, (area, address, all), whole);
        let (count, at) = (usize::from(field.count), at as usize);
        area.copy(block, offset, whole, at, count);
        let missing = partial.missing.checked_sub(field.count.into());
        partial.missing = missing.expect("each field of a read arrives once per poll");
        if partial.missing > 0 {
            return None;
        }
        self.parts.remove(&read)
    }
}

#[cfg(test)]
mod tests;
