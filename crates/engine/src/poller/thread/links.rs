//! Which devices and listeners share a link: those of one address, as long as one of them uses it.

use std::collections::HashMap;
use std::net::IpAddr;
use std::rc::{self, Rc};
use std::sync::Arc;

use holdfast_runtime::Retry;
use tokio::task::spawn_local;

use crate::client::{Endpoint, Place};
use crate::link::{InFlight, Link};
use crate::tls::client::Identity;

/// A link that devices or listeners use. What a removed device has sent may still hold the link itself.
pub(super) struct UsedLink(pub(super) Rc<Link>);

impl UsedLink {
    /// One of its users has left. It is closed if no one else uses it.
    pub(super) fn leave(self: Rc<UsedLink>) {
        if let Some(UsedLink(link)) = Rc::into_inner(self) {
            spawn_local(async move { link.close().await });
        }
    }
}

/// The last link to an address.
struct KnownLink {
    used: rc::Weak<UsedLink>,
    link: rc::Weak<Link>,
    settings: (Endpoint, InFlight, Retry),
}

/// The links to all addresses, each shared by all that ask for it while others use it.
#[derive(Default)]
pub(super) struct Links {
    by_address: HashMap<Address, KnownLink>,
    /// How often a link has lost a user since those that have ended were removed.
    departures: usize,
}

impl Links {
    pub(super) fn to(
        &mut self,
        endpoint: &Endpoint,
        (in_flight, retry): (InFlight, Retry),
    ) -> Rc<UsedLink> {
        let settings = (endpoint.clone(), in_flight, retry);
        let address = address(endpoint);
        let known = self.by_address.get(&address);
        if let Some(used) = known.and_then(|known| known.used.upgrade()) {
            return used;
        }
        let ending = known.and_then(|known| Some((known.link.upgrade()?, &known.settings)));
        let link = match ending {
            Some((link, of)) if *of == settings => link,
            ending => {
                let link = Link::new(endpoint.clone(), in_flight, retry);
                ending.into_iter().for_each(|(before, _)| link.follow(before));
                link
            }
        };
        let used = Rc::new(UsedLink(Rc::clone(&link)));
        let (link, in_use) = (Rc::downgrade(&link), Rc::downgrade(&used));
        self.by_address.insert(address, KnownLink { used: in_use, link, settings });
        used
    }

    /// The next user of the address gets a new link, which follows this one.
    pub(super) fn forget(&mut self, address: &Address) {
        if let Some(known) = self.by_address.get_mut(address) {
            known.used = rc::Weak::new();
        }
        self.departed();
    }

    pub(super) fn device_left(&mut self, left: Rc<UsedLink>) {
        left.leave();
        self.departed();
    }

    /// Removes links that have ended. This looks at all of them, so it waits until it may find many.
    fn departed(&mut self) {
        self.departures += 1;
        if 2 * self.departures >= self.by_address.len() {
            self.by_address.retain(|_, known| known.link.strong_count() > 0);
            self.departures = 0;
        }
    }
}

/// The key of a shared link: its address, and its TLS identity.
pub(super) type Address = (String, Option<Arc<Identity>>);

pub(super) fn address(endpoint: &Endpoint) -> Address {
    let identity = match &endpoint.place {
        Place::Tcp { tls: Some(tls), .. } => Some(Arc::clone(tls.identity())),
        _ => None,
    };
    let (scheme, host, port) = match &endpoint.place {
        // As configured: a link of `/dev/serial` names another device after adapters were plugged in again.
        Place::Serial(line) => return (format!("serial:{}", line.device), None),
        Place::Tcp { host, port, .. } => ("tcp", host, port),
        Place::RtuOverTcp { host, port } => ("rtu+tcp", host, port),
        Place::AsciiOverTcp { host, port } => ("ascii+tcp", host, port),
        Place::Udp { host, port } => ("udp", host, port),
        Place::RtuOverUdp { host, port } => ("rtu+udp", host, port),
    };
    // The same address can be written in several ways.
    let host = match host.parse::<IpAddr>() {
        Ok(address) => address.to_canonical().to_string(),
        Err(_) => host.to_ascii_lowercase(),
    };
    (format!("{scheme}://{host}:{port}"), identity)
}
