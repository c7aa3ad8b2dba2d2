//! One connection to the servers. It is not made again: what it had not sent is lost with it. What it
//! had handed to the system may still arrive later; steps have a deadline for that.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use async_nats::rustls::pki_types::pem::PemObject;
use async_nats::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use async_nats::{Client, ConnectOptions, Event, ServerAddr};
use tokio::sync::watch;

use crate::log::error::{End, LogError};
use crate::log::settings::{Login, Servers};
use crate::log::stream::message_limit::MessageLimit;

/// The most commands that wait for the connection.
const MAX_WAITING_COMMANDS: usize = 4096;

/// How long one attempt to connect may take.
pub(in crate::log) const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);

/// How often the connection is tried.
const PING_INTERVAL: Duration = Duration::from_secs(2);

/// How long requests may take, to JetStream too.
pub(in crate::log) const REQUEST_TIMEOUT: Duration = Duration::from_secs(3);

/// After its end, a client waits for this time before it connects again. It is dropped before.
const NO_RECONNECT_DELAY: Duration = Duration::from_secs(86_400);

pub(in crate::log) struct Connected {
    pub(in crate::log) client: Client,
    pub(in crate::log) server: String,
    pub(in crate::log) end: ConnectionEnd,
    /// The latest error that the server has reported without an end of the connection, such as a missing
    /// permission. Requests only get no answer then.
    pub(in crate::log) error: watch::Receiver<Option<String>>,
}

/// The end of a connection, with its reason.
#[derive(Clone)]
pub(in crate::log) struct ConnectionEnd(watch::Receiver<Option<String>>);

impl ConnectionEnd {
    pub(in crate::log) fn channel() -> (watch::Sender<Option<String>>, ConnectionEnd) {
        let (sender, receiver) = watch::channel(None);
        (sender, ConnectionEnd(receiver))
    }

    pub(in crate::log) async fn wait(&mut self) -> End {
        match self.0.wait_for(Option::is_some).await {
            Ok(reason) => End::Lost(reason.clone().unwrap_or_default()),
            Err(_) => End::Lost("the client has ended".to_owned()),
        }
    }
}

pub(in crate::log) async fn connect(
    servers: &Servers,
    name: String,
    limit: &MessageLimit,
) -> Result<Connected, End> {
    let mut addresses = Vec::new();
    for url in &servers.urls {
        let address: ServerAddr = url
            .parse()
            .map_err(|error| LogError::Settings(format!("servers: {url:?}: {error}")))?;
        addresses.push(address);
    }
    let (sender, end) = ConnectionEnd::channel();
    let (error_sender, error) = watch::channel(None);
    let was_connected = Arc::new(AtomicBool::new(false));
    let options = login(&servers.login).await?;
    let options = match &servers.tls {
        None => options,
        Some(tls) => {
            let options = options.require_tls(true);
            let options = match &tls.ca {
                Some(file) => options.add_root_certificates(certificates(file)?),
                None => options,
            };
            match &tls.identity {
                Some(identity) => options
                    .add_client_certificate(certificates(&identity.cert)?, key(&identity.key)?),
                None => options,
            }
        }
    };
    let connected_before = Arc::clone(&was_connected);
    let exceeded = limit.clone();
    let options = options
        .name(name)
        .connection_timeout(servers.connect_timeout)
        .request_timeout(Some(REQUEST_TIMEOUT))
        .ping_interval(PING_INTERVAL)
        .client_capacity(MAX_WAITING_COMMANDS)
        .ignore_discovered_servers()
        // The client would send what it has not sent before: writes that were refused meanwhile.
        .reconnect_delay_callback(move |_| {
            if connected_before.load(Ordering::Acquire) {
                NO_RECONNECT_DELAY
            } else {
                Duration::ZERO
            }
        })
        .event_callback(move |event| {
            let reason = match event {
                Event::Disconnected | Event::Closed => Some("the connection was lost".to_owned()),
                // The next session finds another server before this one ends.
                Event::LameDuckMode => Some("the server is about to stop".to_owned()),
                Event::ServerError(error) => {
                    let error = error.to_string();
                    let text = error.strip_prefix("nats: ").unwrap_or(&error);
                    let reported = format!("the server reports: {text}");
                    if text.eq_ignore_ascii_case("maximum payload violation") {
                        Some(format!("{reported}: {}", exceeded.exceeded()))
                    } else {
                        error_sender.send_replace(Some(reported));
                        None
                    }
                }
                _ => None,
            };
            // The first reason is the one that the others follow from.
            sender.send_if_modified(|ended| {
                let is_first = ended.is_none() && reason.is_some();
                if is_first {
                    *ended = reason;
                }
                is_first
            });
            std::future::ready(())
        });
    let client = options.connect(addresses).await.map_err(|error| End::lost("connect", error))?;
    was_connected.store(true, Ordering::Release);
    let info = client.server_info();
    limit.connected(info.max_payload);
    let server = format!("{}:{}", info.host, info.port);
    Ok(Connected { client, server, end, error })
}

async fn login(login: &Login) -> Result<ConnectOptions, LogError> {
    let options = ConnectOptions::new();
    Ok(match login {
        Login::None => options,
        Login::User { name, password_file } => {
            let password = password_file.as_deref().map(secret).transpose()?.unwrap_or_default();
            options.user_and_password(name.clone(), password)
        }
        Login::Token { file } => options.token(secret(file)?),
        Login::Credentials { file } => {
            options.credentials_file(file).await.map_err(|error| LogError::file(file, &error))?
        }
    })
}

fn secret(file: &Path) -> Result<String, LogError> {
    let text = std::fs::read_to_string(file).map_err(|error| LogError::file(file, &error))?;
    let text = text.strip_suffix('\n').unwrap_or(&text);
    Ok(text.strip_suffix('\r').unwrap_or(text).to_owned())
}

// The client names no file in its errors, and repeats lines of it: one can have a whole key.

/// The path of a file that has certificates.
fn certificates(file: &Path) -> Result<PathBuf, End> {
    let found: Result<Vec<_>, _> = CertificateDer::pem_reader_iter(opened(file)?).collect();
    usable(file, found.is_ok(), "certificates")
}

/// The path of a file that has a key.
fn key(file: &Path) -> Result<PathBuf, End> {
    usable(file, PrivateKeyDer::from_pem_reader(opened(file)?).is_ok(), "a key")
}

fn opened(file: &Path) -> Result<BufReader<File>, LogError> {
    File::open(file).map(BufReader::new).map_err(|error| LogError::file(file, &error))
}

fn usable(file: &Path, is_usable: bool, what: &str) -> Result<PathBuf, End> {
    if is_usable {
        return Ok(file.to_owned());
    }
    // It may be being written.
    Err(End::Lost(format!("{}: {what} can't be read, allowed: PEM, in lines", file.display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Such a line was repeated in errors, byte for byte.
    #[test]
    fn what_is_wrong_with_a_key_or_a_certificate_is_said_without_its_content() {
        let begin = "-----BEGIN PRIVATE KEY-----";
        let file = std::env::temp_dir().join(format!("holdfast-one-line-{}", std::process::id()));
        for text in
            [format!("{begin} c2VjcmV0 -----END PRIVATE KEY-----"), format!("{begin}\nc2Vj")]
        {
            std::fs::write(&file, text).unwrap();
            for (found, what) in [(key(&file), "a key"), (certificates(&file), "certificates")] {
                let expected =
                    format!("{}: {what} can't be read, allowed: PEM, in lines", file.display());
                assert_eq!(found.unwrap_err().reason(), expected);
            }
        }
        std::fs::remove_file(&file).unwrap();
    }
}
