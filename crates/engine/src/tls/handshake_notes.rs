//! What the callbacks of rustls find out about a connection. rustls does not tell them which
//! connection they work for, so its notes are lent to them while it processes bytes.

use std::cell::RefCell;
use std::mem;
use std::sync::Arc;

use rustls::pki_types::{CertificateDer, UnixTime};

use super::TlsFailure;

/// A certificate and its intermediates.
pub(super) type Chain = Arc<[CertificateDer<'static>]>;

/// The notes of one connection.
#[derive(Debug, Default)]
pub(super) struct Notes {
    /// What the peer presented, now or in the session that it resumes.
    pub(super) chain: Option<Chain>,
    /// When the peer proved that it has the key of its certificate.
    pub(super) proved: Option<UnixTime>,
    /// Why the chain was refused. The error of rustls decides about the alert, and has fewer words.
    pub(super) failure: Option<TlsFailure>,
    /// The key of the stored session of the connection.
    pub(super) session: Option<Vec<u8>>,
}

thread_local! {
    static LENT: RefCell<Notes> = RefCell::default();
}

impl Notes {
    /// Does some work whose callbacks may use these notes.
    pub(super) fn lend<R>(&mut self, work: impl FnOnce() -> R) -> R {
        LENT.with_borrow_mut(|lent| mem::swap(lent, self));
        let result = work();
        LENT.with_borrow_mut(|lent| mem::swap(lent, self));
        result
    }
}

/// Uses the notes of the connection that is worked for.
pub(super) fn noted<R>(with: impl FnOnce(&mut Notes) -> R) -> R {
    LENT.with_borrow_mut(with)
}
