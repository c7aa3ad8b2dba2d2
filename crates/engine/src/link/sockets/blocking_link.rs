//! A link that sends one request at a time, by blocking calls in a thread that ends with the link.

use std::cell::Cell;
use std::sync::Arc;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

use holdfast_protocol::client::Closed;
use holdfast_protocol::pdu::EncodedRequest;
use holdfast_runtime::Retry;
use tokio::sync::oneshot;
use tokio::time::Instant;

use crate::client::{
    BlockingClient, ClientError, Conditions, Endpoint, Lost, Place, StrayCounters,
};
use crate::link::fault::Exchanged;
use crate::link::limits::connect_pause::{ConnectPause, DuringPause};
use crate::link::limits::flood::Flood;
use crate::link::limits::lease_fence::Pass;
use crate::link::limits::permit::Permit;

/// How often an idle serial line is looked at: the system gives the name of a lost adapter to the next one
/// only when nobody has it open.
const LINE_CHECK_INTERVAL: Duration = Duration::from_secs(1);

pub(in crate::link) struct BlockingLink {
    jobs: mpsc::Sender<Job>,
    retry_at: Cell<Option<Instant>>,
    strays: Arc<StrayCounters>,
}

enum Job {
    Call(Call),
    Release,
}

struct Call {
    unit_id: u8,
    request: Box<EncodedRequest>,
    timeout: Duration,
    during_pause: DuringPause,
    permit: Permit,
    /// The result, and when an endpoint that could not be opened is tried again.
    answer: oneshot::Sender<(Exchanged, Option<Instant>)>,
}

impl BlockingLink {
    pub(in crate::link) fn new(endpoint: Endpoint, retry: Retry) -> BlockingLink {
        let (jobs, queue) = mpsc::channel::<Job>();
        // Others may use a serial line too, and its speed limits what it can cost.
        let is_line = matches!(endpoint.place, Place::Serial(_));
        let client = BlockingClient::new(endpoint);
        let strays = Arc::clone(client.strays());
        let counted = Arc::clone(&strays);
        let work = move || {
            let pause = ConnectPause::new(retry);
            // While there may be a connection.
            let mut pass: Option<Pass> = None;
            let flood = (!is_line).then(|| Flood::new(counted, retry));
            let idle = if is_line { LINE_CHECK_INTERVAL } else { Duration::MAX };
            loop {
                match queue.recv_timeout(idle) {
                    Err(RecvTimeoutError::Disconnected) => return,
                    Err(RecvTimeoutError::Timeout) => client.close_if_lost(),
                    // A stopped device no longer waits for its read.
                    Ok(Job::Call(call)) if call.answer.is_closed() => {}
                    Ok(Job::Call(call)) => {
                        if let Some(fence) = &call.permit.fence {
                            pass.get_or_insert_with(|| fence.pass());
                        }
                        let answer = carried_out(&client, &call, &pause);
                        let flooded = flood.as_ref().and_then(|flood| flood.until(Instant::now()));
                        if let Some(until) = flooded {
                            client.close(None);
                            pause.flooded(until);
                        }
                        let _ = call.answer.send((answer, pause.until()));
                    }
                    Ok(Job::Release) => {
                        client.close(None);
                        pass = None;
                    }
                }
            }
        };
        // If the thread does not start, every job fails, and the device reports the fault.
        let _ = std::thread::Builder::new().name("holdfast-line".into()).spawn(work);
        BlockingLink { jobs, retry_at: Cell::new(None), strays }
    }

    pub(in crate::link) async fn exchange(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        during_pause: DuringPause,
        permit: &Permit,
    ) -> Exchanged {
        let ended = || Arc::new(ClientError::Lost(Lost::Closed(Closed::BySelf)));
        let (answer, answered) = oneshot::channel();
        let request = Box::new(request.clone());
        let permit = permit.clone();
        let call = Call { unit_id, request, timeout, during_pause, permit, answer };
        self.jobs.send(Job::Call(call)).map_err(|_| ended())?;
        let (answer, retry_at) = answered.await.unwrap_or_else(|_| (Err(ended()), None));
        self.retry_at.set(retry_at);
        answer
    }

    pub(in crate::link) fn strays(&self) -> &Arc<StrayCounters> {
        &self.strays
    }

    /// The end of the pause after the last failed attempt to open the endpoint.
    pub(in crate::link) fn retry_at(&self) -> Option<Instant> {
        self.retry_at.get()
    }

    /// Closes the connection after the requests before this call.
    pub(in crate::link) fn release(&self) {
        let _ = self.jobs.send(Job::Release);
    }
}

fn carried_out(client: &BlockingClient, call: &Call, pause: &ConnectPause) -> Exchanged {
    if call.during_pause == DuringPause::Fail {
        pause.check()?;
    }
    let Call { unit_id, ref request, timeout, ref permit, .. } = *call;
    let allows = permit.fence.as_ref().map(|fence| || fence.allows());
    let conditions = Conditions {
        may_send: &|moment| permit.check(moment),
        may_continue: allows.as_ref().map(|allows| allows as &dyn Fn() -> bool),
        peers: permit.peers.clone(),
    };
    let answer = client.call(&conditions, unit_id, request, timeout, |_, pdu| pdu.to_vec());
    let answer = answer.map_err(Arc::new);
    match &answer {
        Err(error) => match **error {
            ClientError::Connect { .. }
            | ClientError::ConnectTimeout { .. }
            | ClientError::LookupTimeout { .. }
            | ClientError::Tls { maybe_sent: false, .. } => {
                pause.failed(Arc::clone(error));
            }
            // It was not tried.
            ClientError::Fenced | ClientError::Expired | ClientError::Elsewhere => {}
            _ => pause.connected(),
        },
        Ok(_) => pause.connected(),
    }
    answer
}
