//! A link that sends one request at a time, by blocking calls in a thread that ends with the link.

use std::cell::Cell;
use std::sync::mpsc;
use std::time::Duration;

use holdfast_protocol::pdu::EncodedRequest;
use tokio::sync::oneshot;
use tokio::time::Instant;

use super::backoff;
use super::fault::{Answer, Fault};
use crate::client::{BlockingClient, ClientError, Endpoint};

pub(super) struct BlockingLink {
    jobs: mpsc::Sender<Job>,
    retry_at: Cell<Option<Instant>>,
}

enum Job {
    Call(Call),
    Release,
}

struct Call {
    unit_id: u8,
    request: Box<EncodedRequest>,
    timeout: Duration,
    eager: bool,
    /// The result, and when an endpoint that could not be opened is tried again.
    answer: oneshot::Sender<(Answer, Option<Instant>)>,
}

impl BlockingLink {
    pub(super) fn new(endpoint: Endpoint) -> BlockingLink {
        let (jobs, queue) = mpsc::channel::<Job>();
        let client = BlockingClient::new(endpoint);
        let work = move || {
            let (mut failures, mut retry_at) = (0, None);
            for job in queue {
                match job {
                    // A stopped device no longer waits for its read.
                    Job::Call(call) if call.answer.is_closed() => {}
                    Job::Call(call) => {
                        let answer = carried_out(&client, &call, &mut failures, &mut retry_at);
                        let _ = call.answer.send((answer, retry_at));
                    }
                    Job::Release => client.close(),
                }
            }
        };
        // If the thread does not start, every job fails, and the device reports the fault.
        let _ = std::thread::Builder::new().name("holdfast-line".into()).spawn(work);
        BlockingLink { jobs, retry_at: Cell::new(None) }
    }

    pub(super) async fn exchange(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        eager: bool,
    ) -> Answer {
        let (answer, answered) = oneshot::channel();
        let request = Box::new(request.clone());
        let call = Call { unit_id, request, timeout, eager, answer };
        self.jobs.send(Job::Call(call)).or(Err(Fault::Reset))?;
        let (answer, retry_at) = answered.await.unwrap_or((Err(Fault::Reset), None));
        self.retry_at.set(retry_at);
        answer
    }

    /// The end of the pause after the last failed attempt to open the endpoint.
    pub(super) fn retry_at(&self) -> Option<Instant> {
        self.retry_at.get()
    }

    /// Closes the connection after the requests before this call.
    pub(super) fn release(&self) {
        let _ = self.jobs.send(Job::Release);
    }
}

fn carried_out(
    client: &BlockingClient,
    call: &Call,
    failures: &mut u32,
    retry_at: &mut Option<Instant>,
) -> Answer {
    if !call.eager && retry_at.is_some_and(|time| Instant::now() < time) {
        return Err(Fault::Refused);
    }
    let answer = client.call(call.unit_id, &call.request, call.timeout, |_, pdu| pdu.to_vec());
    let fault = match &answer {
        Err(ClientError::Connect { .. } | ClientError::Tls { maybe_sent: false, .. }) => {
            *failures = failures.saturating_add(1);
            *retry_at = Some(Instant::now() + backoff::pause(*failures, backoff::MAX_PAUSE));
            return Err(Fault::Refused);
        }
        Err(ClientError::Exception(code)) => Fault::Exception(*code),
        Err(ClientError::Timeout(_) | ClientError::ConnectTimeout { .. }) => Fault::Timeout,
        Err(ClientError::Invalid(_)) => Fault::Invalid,
        Ok(_) | Err(ClientError::Lost(_) | ClientError::Tls { .. }) => Fault::Reset,
    };
    (*failures, *retry_at) = (0, None);
    answer.or(Err(fault))
}
