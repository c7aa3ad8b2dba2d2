//! What the connections of a server have in common: settings, certificates, counters, and where
//! requests go.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use ipnet::IpNet;

use super::exchange::{Event, Exchange, WeakConnection};
use super::inbox::Inbox;
use super::refusal::{Refusal, RefusalBody};
use crate::server::Peer;
use crate::server::connections::admission::ConnectionLimits;
use crate::server::connections::listener::ListenerContext;
use crate::server::connections::reloadable::Reloadable;
use crate::server::reports::event::{Kind, Reporter};
use crate::tls::TlsFailure;
use crate::tls::server::ServerTls;

#[derive(Debug)]
pub struct HttpSettings {
    pub name: String,
    /// The networks of the clients.
    pub sources: Vec<IpNet>,
    pub limits: ConnectionLimits,
    /// For a request to arrive, and for a response to be taken.
    pub request_timeout: Duration,
    /// For the next request to begin.
    pub idle_timeout: Duration,
    /// Whether a client that sends no more is gone.
    pub leaving: bool,
    /// In the order of [`Refusal::ALL`].
    pub refusals: [RefusalBody; Refusal::ALL.len()],
}

/// What the connections of a server have in common.
pub(super) struct Front {
    pub(super) context: Arc<ListenerContext>,
    pub(super) inbox: Arc<Inbox<Event>>,
    pub(super) settings: HttpSettings,
    tls: Option<Reloadable<ServerTls>>,
    next: AtomicU64,
}

impl Front {
    pub(super) fn new(
        settings: HttpSettings,
        tls: Option<Arc<ServerTls>>,
        inbox: Arc<Inbox<Event>>,
        reporter: Reporter,
    ) -> Front {
        let context = ListenerContext::new(&settings.name, Some(settings.limits), reporter, None);
        Front {
            context: Arc::new(context),
            inbox,
            settings,
            tls: tls.map(Reloadable::from),
            next: AtomicU64::new(0),
        }
    }

    /// Uses these certificates for new connections. Returns those before.
    pub(super) fn set_tls(&self, tls: Arc<ServerTls>) -> Option<Arc<ServerTls>> {
        self.tls.as_ref().map(|live| live.replace(tls))
    }

    pub(super) fn tls(&self) -> Option<Arc<ServerTls>> {
        self.tls.as_ref().map(Reloadable::get)
    }

    pub(super) fn refusal(&self, refusal: Refusal) -> &RefusalBody {
        &self.settings.refusals[refusal as usize]
    }

    /// Counts and reports the end of a connection, or what is wrong with it.
    pub(super) fn ended(&self, kind: Kind, peer: Peer) {
        self.context.ended(kind, peer);
        self.inbox.wake();
    }

    /// A new exchange of a connection.
    pub(super) fn exchange(&self, connection: WeakConnection) -> Arc<Exchange> {
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        Exchange::new(number, Arc::clone(&self.inbox), connection)
    }
}

/// Why a connection that began with the certificates `before` ends, now that these have taken their place;
/// `None` if it stays.
pub(super) fn fails(tls: &ServerTls, before: &ServerTls, peer: &Peer) -> Option<Kind> {
    let requires_now = tls.requires_certificate() && !before.requires_certificate();
    let failure = match &peer.certificate {
        Some(certificate) => tls.judge(certificate).err()?,
        None => requires_now.then_some(TlsFailure::NoCertificate)?,
    };
    Some(Kind::TlsFailed(failure.reason()))
}
