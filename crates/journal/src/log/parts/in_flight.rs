//! Messages of this node that were sent, until they are applied, and the writers who wait for them.

use std::collections::VecDeque;
use std::time::Instant;

use bytes::Bytes;
use holdfast_memory::{Done, Outcome, Refusal};
use holdfast_runtime::Counter;

use crate::log::clock::Moment;
use crate::log::shared::refuse_all;
use crate::log::status::Counters;

/// The most messages with unanswered steps. Further steps wait, and are sent as one batch.
const MAX_OPEN_MESSAGES: usize = 16;

/// The most messages that are remembered although their steps were answered, or they have none: the time
/// when they were sent is needed when they are applied.
const MAX_REMEMBERED_MESSAGES: usize = 4096;

#[derive(Default)]
pub(in crate::log) struct InFlight {
    messages: VecDeque<Message>,
    /// How many messages have steps that were not answered.
    open: usize,
}

struct Message {
    counter: u64,
    payload: Bytes,
    /// Empty if there are no steps, and when they were answered.
    steps: Vec<Done>,
    first_sent: Moment,
    attempts: u32,
    /// When its steps are answered as not confirmed; `None` if it was sent without steps.
    until: Option<Instant>,
}

impl InFlight {
    pub(in crate::log) fn has_room(&self) -> bool {
        self.open < MAX_OPEN_MESSAGES
    }

    /// Whether a step was not answered.
    pub(in crate::log) fn has_open_steps(&self) -> bool {
        self.open > 0
    }

    pub(in crate::log) fn push(
        &mut self,
        (counter, payload): (u64, Bytes),
        steps: Vec<Done>,
        first_sent: Moment,
        until: Option<Instant>,
    ) {
        debug_assert!(self.messages.back().is_none_or(|last| last.counter < counter));
        if self.messages.len() >= MAX_REMEMBERED_MESSAGES
            && self.messages.front().is_some_and(Message::is_answered)
        {
            self.messages.pop_front();
        }
        self.open += usize::from(!steps.is_empty());
        self.messages.push_back(Message {
            counter,
            payload,
            steps,
            first_sent,
            attempts: 1,
            until,
        });
    }

    /// When a message was sent first, if it is remembered.
    pub(in crate::log) fn first_sent(&self, counter: u64) -> Option<Moment> {
        let message = self.messages.iter().find(|message| message.counter == counter);
        message.map(|message| message.first_sent)
    }

    /// A message was applied. Returns when it was sent first. Those before it will never be.
    pub(in crate::log) fn applied(
        &mut self,
        counter: u64,
        outcomes: Vec<Outcome>,
        counters: &Counters,
    ) -> Option<Moment> {
        let is_before = |first: &Message| first.counter < counter;
        self.forget_while(is_before, Refusal::Unavailable, &counters.unavailable);
        self.messages.front().filter(|first| first.counter == counter)?;
        let message = self.messages.pop_front()?;
        self.close(&message);
        // Steps that were answered before were counted then.
        for (done, mut outcome) in message.steps.into_iter().zip(outcomes) {
            match &mut outcome {
                Ok(_) => counters.steps.add(),
                Err(refused) => {
                    counters.refused.add();
                    // It came too late for all nodes: none carries it out.
                    if refused.refusal == Refusal::NotConfirmed {
                        refused.refusal = Refusal::Unavailable;
                    }
                }
            }
            done(outcome);
        }
        Some(message.first_sent)
    }

    /// No server was there to store the message.
    pub(in crate::log) fn not_taken(&mut self, counter: u64, counters: &Counters) {
        self.answer(counter, Refusal::Unavailable, &counters.unavailable);
    }

    /// The servers refused the message. Whether it was stored is not known for sure.
    pub(in crate::log) fn refused_by_stream(&mut self, counter: u64, counters: &Counters) {
        self.answer(counter, Refusal::NotConfirmed, &counters.not_confirmed);
    }

    fn answer(&mut self, counter: u64, refusal: Refusal, counted: &Counter) {
        let message = self.messages.iter_mut().find(|message| message.counter == counter);
        // A message that was sent twice may have been stored the other time.
        let Some(message) = message.filter(|message| message.attempts == 1) else { return };
        let steps = message.take_steps();
        self.open -= usize::from(!steps.is_empty());
        refuse_all(steps, refusal, counted);
    }

    /// Messages up to this counter may have been applied where this node did not see it: a snapshot has
    /// their results, but not their outcomes.
    pub(in crate::log) fn give_up_until(&mut self, counter: u64, counters: &Counters) {
        let is_among = |first: &Message| first.counter <= counter;
        self.forget_while(is_among, Refusal::NotConfirmed, &counters.not_confirmed);
    }

    fn forget_while(
        &mut self,
        is_over: impl Fn(&Message) -> bool,
        refusal: Refusal,
        counted: &Counter,
    ) {
        while self.messages.front().is_some_and(&is_over) {
            if let Some(message) = self.messages.pop_front() {
                self.close(&message);
                refuse_all(message.steps, refusal, counted);
            }
        }
    }

    /// Answers steps that were not confirmed in time.
    pub(in crate::log) fn expire(&mut self, now: Instant, counters: &Counters) {
        let is_late = |message: &&mut Message| message.until.is_some_and(|until| until <= now);
        for message in self.messages.iter_mut().filter(is_late) {
            let steps = message.take_steps();
            self.open -= usize::from(!steps.is_empty());
            refuse_all(steps, Refusal::NotConfirmed, &counters.not_confirmed);
        }
    }

    /// Messages whose outcome was not reported, to send them again in a new session. The others are
    /// forgotten: they are never sent again.
    pub(in crate::log) fn take_unanswered(&mut self) -> Vec<(u64, Bytes)> {
        self.messages.retain(|message| !message.is_answered());
        self.messages
            .iter_mut()
            .map(|message| {
                message.attempts += 1;
                (message.counter, message.payload.clone())
            })
            .collect()
    }

    /// A message is no longer remembered.
    fn close(&mut self, message: &Message) {
        self.open -= usize::from(!message.is_answered());
    }
}

impl Message {
    /// The steps, to be answered now. The message is not sent again.
    fn take_steps(&mut self) -> Vec<Done> {
        self.payload = Bytes::new();
        std::mem::take(&mut self.steps)
    }

    fn is_answered(&self) -> bool {
        self.steps.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, channel};
    use std::time::Duration;

    use holdfast_memory::{CarriedOut, Refused};

    use super::*;
    use crate::log::clock::Clock;

    fn push(in_flight: &mut InFlight, counter: u64, until: Instant) -> Receiver<Outcome> {
        let (sender, receiver) = channel();
        let done: Done = Box::new(move |outcome| sender.send(outcome).unwrap());
        let message = (counter, Bytes::from_static(b"steps"));
        in_flight.push(message, vec![done], Clock::default().now(), Some(until));
        receiver
    }

    fn refused(refusal: Refusal) -> Outcome {
        Err(Refused { index: 0, refusal })
    }

    fn later() -> Instant {
        Instant::now() + Duration::from_secs(60)
    }

    #[test]
    fn a_message_before_one_that_was_applied_never_will_be() {
        let (mut in_flight, counters) = (InFlight::default(), Counters::default());
        let [one, two, three] = [1, 2, 3].map(|counter| push(&mut in_flight, counter, later()));
        let read = CarriedOut { read: vec![7], sequence: Some(3) };
        assert!(in_flight.applied(2, vec![Ok(read.clone())], &counters).is_some());
        assert_eq!(one.try_recv(), Ok(refused(Refusal::Unavailable)));
        assert_eq!(two.try_recv(), Ok(Ok(read)));
        assert!(three.try_recv().is_err());
        assert_eq!((counters.steps.get(), counters.unavailable.get()), (1, 1));
        assert!(in_flight.has_open_steps());
    }

    #[test]
    fn a_message_that_a_snapshot_may_have_is_unclear() {
        let (mut in_flight, counters) = (InFlight::default(), Counters::default());
        let [one, two] = [1, 2].map(|counter| push(&mut in_flight, counter, later()));
        in_flight.give_up_until(1, &counters);
        assert_eq!(one.try_recv(), Ok(refused(Refusal::NotConfirmed)));
        assert!(two.try_recv().is_err());
        assert_eq!(in_flight.take_unanswered().len(), 1);
    }

    #[test]
    fn a_message_whose_steps_were_answered_is_not_sent_again() {
        let (mut in_flight, counters) = (InFlight::default(), Counters::default());
        let [late, open] = [Instant::now(), later()];
        let (one, two) = (push(&mut in_flight, 1, late), push(&mut in_flight, 2, open));
        in_flight.expire(Instant::now(), &counters);
        assert_eq!(one.try_recv(), Ok(refused(Refusal::NotConfirmed)));
        assert_eq!(in_flight.take_unanswered(), [(2, Bytes::from_static(b"steps"))]);
        assert!(two.try_recv().is_err());
        assert_eq!(in_flight.applied(1, vec![Ok(CarriedOut::default())], &counters), None);
        assert_eq!(counters.not_confirmed.get(), 1);
    }

    #[test]
    fn a_step_that_came_too_late_for_all_nodes_is_not_unclear_to_a_writer_who_still_waits() {
        let (mut in_flight, counters) = (InFlight::default(), Counters::default());
        let (one, two) =
            (push(&mut in_flight, 1, Instant::now()), push(&mut in_flight, 2, later()));
        in_flight.expire(Instant::now(), &counters);
        for counter in [1, 2] {
            let late = vec![refused(Refusal::NotConfirmed)];
            assert!(in_flight.applied(counter, late, &counters).is_some());
        }
        assert_eq!(one.try_recv(), Ok(refused(Refusal::NotConfirmed)));
        assert_eq!(two.try_recv(), Ok(refused(Refusal::Unavailable)));
        assert_eq!((counters.not_confirmed.get(), counters.refused.get()), (1, 1));
    }

    #[test]
    fn steps_are_answered_in_time_behind_a_message_that_may_take_longer() {
        let (mut in_flight, counters) = (InFlight::default(), Counters::default());
        let now = Instant::now();
        let waiting = push(&mut in_flight, 1, later());
        let late = [2, 3].map(|counter| push(&mut in_flight, counter, now));
        in_flight.expire(now, &counters);
        for late in late {
            assert_eq!(late.try_recv(), Ok(refused(Refusal::NotConfirmed)));
        }
        assert!(waiting.try_recv().is_err());
        assert_eq!(counters.not_confirmed.get(), 2);
    }

    #[test]
    fn only_a_message_that_was_sent_once_is_known_not_to_be_stored() {
        let (mut in_flight, counters) = (InFlight::default(), Counters::default());
        let one = push(&mut in_flight, 1, later());
        in_flight.take_unanswered();
        in_flight.not_taken(1, &counters);
        assert!(one.try_recv().is_err(), "the first time, it may have been stored");
        let two = push(&mut in_flight, 2, later());
        in_flight.not_taken(2, &counters);
        assert_eq!(two.try_recv(), Ok(refused(Refusal::Unavailable)));
        let three = push(&mut in_flight, 3, later());
        in_flight.refused_by_stream(3, &counters);
        assert_eq!(three.try_recv(), Ok(refused(Refusal::NotConfirmed)));
    }
}
