//! `ServerTls`: the certificates of a TLS server, of a listener or of HTTPS.

use std::path::PathBuf;
use std::sync::Arc;

use holdfast_engine::tls::server::{Protocol, ServerFiles, ServerTls as CoreServerTls};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// Settings of a TLS server with mutual authentication. Reads the PEM files at once.
///
/// `ca_file` has the authorities of client certificates, and clients' own certificates;
/// `crl_file` has the revocation lists of these authorities. `decrypted_key` is the content of
/// `key_file` without its passphrase, if it has one. Raises `ValueError` for a file that can't be
/// used.
#[pyclass(frozen, module = "holdfast")]
pub struct ServerTls {
    pub(crate) core: Arc<CoreServerTls>,
}

#[pymethods]
impl ServerTls {
    #[new]
    #[pyo3(signature = (*, cert_file, key_file, ca_file, crl_file=None, decrypted_key=None))]
    fn new(
        py: Python<'_>,
        cert_file: PathBuf,
        key_file: PathBuf,
        ca_file: PathBuf,
        crl_file: Option<PathBuf>,
        decrypted_key: Option<&[u8]>,
    ) -> PyResult<ServerTls> {
        let files = ServerFiles {
            protocol: Protocol::Modbus,
            cert_file,
            key_file,
            ca_file: Some(ca_file),
            crl_file,
            roles: None,
        };
        load(py, &files, decrypted_key)
    }

    /// What is doubtful about the files: dates, and revocation lists.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.core.warnings().to_vec()
    }
}

/// Settings of the TLS of an HTTPS server. Reads the PEM files at once.
///
/// Without `client_ca_file`, clients need no certificate. `roles` are the allowed roles of their
/// certificates: "" is a certificate without a role, `None` is any role. The other arguments and the
/// exceptions are those of `ServerTls`.
#[pyfunction]
#[pyo3(signature = (*, cert_file, key_file, client_ca_file=None, crl_file=None, roles=None, decrypted_key=None))]
#[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
pub fn https_server_tls(
    py: Python<'_>,
    cert_file: PathBuf,
    key_file: PathBuf,
    client_ca_file: Option<PathBuf>,
    crl_file: Option<PathBuf>,
    roles: Option<Vec<String>>,
    decrypted_key: Option<&[u8]>,
) -> PyResult<ServerTls> {
    let files = ServerFiles {
        protocol: Protocol::Http,
        cert_file,
        key_file,
        ca_file: client_ca_file,
        crl_file,
        roles,
    };
    load(py, &files, decrypted_key)
}

impl ServerTls {
    /// The settings, if they are for servers of this protocol.
    pub(crate) fn of(&self, protocol: Protocol) -> PyResult<Arc<CoreServerTls>> {
        if self.core.protocol() == protocol {
            return Ok(Arc::clone(&self.core));
        }
        Err(PyValueError::new_err(match protocol {
            Protocol::Http => "tls is for a Modbus listener; use https_server_tls(...)",
            Protocol::Modbus => "tls is for an HTTPS server; use ServerTls(...)",
        }))
    }
}

fn load(py: Python<'_>, files: &ServerFiles, decrypted_key: Option<&[u8]>) -> PyResult<ServerTls> {
    // Reading may block: let other Python threads run.
    let core = py.detach(|| CoreServerTls::load(files, decrypted_key));
    let core = core.map_err(|error| PyValueError::new_err(error.to_string()))?;
    Ok(ServerTls { core: Arc::new(core) })
}
