//! A link that sends one request at a time, by blocking calls in a thread that ends with the link.

use std::cell::Cell;
use std::sync::{Arc, mpsc};
use std::time::Duration;

use holdfast_protocol::client::Closed;
use holdfast_protocol::pdu::EncodedRequest;
use holdfast_runtime::Retry;
use tokio::sync::oneshot;
use tokio::time::Instant;

use super::fault::{Exchanged, FLOODED, Fault, fault};
use super::fence::Pass;
use super::flood::Flood;
use super::permit::Permit;
use crate::client::{
    BlockingClient, ClientError, Conditions, Endpoint, Lost, Place, StrayCounters,
};

pub(super) struct BlockingLink {
    jobs: mpsc::Sender<Job>,
    retry_at: Cell<Option<Instant>>,
    strays: Arc<StrayCounters>,
}

/// An endpoint that could not be opened: since how many attempts, when it is tried again, and why.
struct Failed {
    attempts: u32,
    until: Instant,
    error: Arc<ClientError>,
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
    permit: Permit,
    /// The result, and when an endpoint that could not be opened is tried again.
    answer: oneshot::Sender<(Exchanged, Option<Instant>)>,
}

impl BlockingLink {
    pub(super) fn new(endpoint: Endpoint, retry: Retry) -> BlockingLink {
        let (jobs, queue) = mpsc::channel::<Job>();
        // Others may use a serial line too, and its speed limits what it can cost.
        let is_line = matches!(endpoint.place, Place::Serial(_));
        let client = BlockingClient::new(endpoint);
        let strays = Arc::clone(client.strays());
        let counted = Arc::clone(&strays);
        let work = move || {
            let mut failed = None;
            // While there may be a connection.
            let mut pass: Option<Pass> = None;
            let flood = (!is_line).then(|| Flood::new(counted, retry));
            for job in queue {
                match job {
                    // A stopped device no longer waits for its read.
                    Job::Call(call) if call.answer.is_closed() => {}
                    Job::Call(call) => {
                        if let Some(fence) = &call.permit.fence {
                            pass.get_or_insert_with(|| fence.pass());
                        }
                        let answer = carried_out(&client, retry, &call, &mut failed);
                        let flooded = flood.as_ref().and_then(|flood| flood.until(Instant::now()));
                        if let Some(until) = flooded {
                            client.close();
                            let error = Arc::new(FLOODED);
                            failed = Some(Failed { attempts: 0, until, error });
                        }
                        let retry_at = failed.as_ref().map(|failed| failed.until);
                        let _ = call.answer.send((answer, retry_at));
                    }
                    Job::Release => {
                        client.close();
                        pass = None;
                    }
                }
            }
        };
        // If the thread does not start, every job fails, and the device reports the fault.
        let _ = std::thread::Builder::new().name("holdfast-line".into()).spawn(work);
        BlockingLink { jobs, retry_at: Cell::new(None), strays }
    }

    pub(super) async fn exchange(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        eager: bool,
        permit: &Permit,
    ) -> Exchanged {
        let ended = || Arc::new(ClientError::Lost(Lost::Closed(Closed::BySelf)));
        let (answer, answered) = oneshot::channel();
        let request = Box::new(request.clone());
        let permit = permit.clone();
        let call = Call { unit_id, request, timeout, eager, permit, answer };
        self.jobs.send(Job::Call(call)).map_err(|_| ended())?;
        let (answer, retry_at) = answered.await.unwrap_or_else(|_| (Err(ended()), None));
        self.retry_at.set(retry_at);
        answer
    }

    pub(super) fn strays(&self) -> &Arc<StrayCounters> {
        &self.strays
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
    retry: Retry,
    call: &Call,
    failed: &mut Option<Failed>,
) -> Exchanged {
    if let Some(Failed { until, error, .. }) = failed
        && !call.eager
        && Instant::now() < *until
    {
        return Err(Arc::clone(error));
    }
    let Call { unit_id, ref request, timeout, ref permit, .. } = *call;
    let allows = permit.fence.as_ref().map(|fence| || fence.allows());
    let conditions = Conditions {
        to_begin: &|| permit.check(),
        to_go_on: allows.as_ref().map(|allows| allows as &dyn Fn() -> bool),
    };
    let answer = client.call_under(&conditions, unit_id, request, timeout, |_, pdu| pdu.to_vec());
    let answer = answer.map_err(Arc::new);
    *failed = match &answer {
        Err(error) if matches!(fault(error), Fault::Refused | Fault::Unreachable) => {
            let attempts = failed.take().map_or(0, |failed| failed.attempts).saturating_add(1);
            let until = Instant::now() + retry.pause(attempts);
            Some(Failed { attempts, until, error: Arc::clone(error) })
        }
        // It was not tried.
        Err(error) if matches!(**error, ClientError::Fenced | ClientError::Expired) => {
            failed.take()
        }
        _ => None,
    };
    answer
}
