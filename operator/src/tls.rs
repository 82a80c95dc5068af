//! TLS for the task server, with a certificate that is renewed while it serves.

use std::net::SocketAddr;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use rustls::ServerConfig;
use rustls::crypto::ring;
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use tokio::io;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, mpsc};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

/// A client that takes longer to shake hands is none.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// Handshakes at a time.
const HANDS: usize = 64;

/// The certificate in use.
#[derive(Debug)]
pub struct Current(RwLock<Arc<CertifiedKey>>);

impl Current {
    /// With this one.
    pub fn new(key: CertifiedKey) -> Arc<Self> {
        Arc::new(Current(RwLock::new(Arc::new(key))))
    }
    /// Connections from now on have this one.
    pub fn set(&self, key: CertifiedKey) {
        *self.0.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(key);
    }
    /// The one that connections have now.
    pub fn now(&self) -> Arc<CertifiedKey> {
        self.0.read().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl ResolvesServerCert for Current {
    fn resolve(&self, _: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(self.now())
    }
}

/// Connections whose handshake is done.
pub struct Tls {
    ready: mpsc::Receiver<(TlsStream<TcpStream>, SocketAddr)>,
    address: SocketAddr,
}

impl Tls {
    /// Begins to listen. `refused` is called for each connection that does not become one.
    ///
    /// # Errors
    /// When the address cannot be had.
    pub async fn listen(
        address: SocketAddr,
        current: Arc<Current>,
        refused: impl Fn() + Send + Sync + 'static,
    ) -> anyhow::Result<Self> {
        let listener = TcpListener::bind(address).await?;
        let address = listener.local_addr()?;
        let builder = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()));
        let mut config =
            builder.with_safe_default_protocol_versions()?.with_no_client_auth().with_cert_resolver(current);
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        let (done, ready) = mpsc::channel(HANDS);
        tokio::spawn(accept(listener, TlsAcceptor::from(Arc::new(config)), done, Arc::new(refused)));
        Ok(Tls { ready, address })
    }
}

async fn accept(
    listener: TcpListener,
    acceptor: TlsAcceptor,
    done: mpsc::Sender<(TlsStream<TcpStream>, SocketAddr)>,
    refused: Arc<impl Fn() + Send + Sync + 'static>,
) {
    let hands = Arc::new(Semaphore::new(HANDS));
    loop {
        let Ok(hand) = hands.clone().acquire_owned().await else { return };
        let (stream, from) = match listener.accept().await {
            Ok(found) => found,
            Err(e) => {
                // no more files, as a rule: others close theirs
                tracing::warn!("cannot accept a connection: {e}");
                tokio::time::sleep(Duration::from_millis(200)).await;
                continue;
            }
        };
        let (acceptor, done, refused) = (acceptor.clone(), done.clone(), refused.clone());
        // one that is slow must not keep the others
        tokio::spawn(async move {
            match tokio::time::timeout(HANDSHAKE, acceptor.accept(stream)).await {
                Ok(Ok(stream)) => {
                    // nobody serves any more
                    let _ = done.send((stream, from)).await;
                }
                Ok(Err(e)) => {
                    tracing::debug!("{from}: {e}");
                    refused();
                }
                Err(_) => refused(),
            }
            drop(hand);
        });
    }
}

impl axum::serve::Listener for Tls {
    type Io = TlsStream<TcpStream>;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Self::Io, Self::Addr) {
        match self.ready.recv().await {
            Some(found) => found,
            // the accepting task ends with the process only
            None => std::future::pending().await,
        }
    }
    fn local_addr(&self) -> io::Result<SocketAddr> {
        Ok(self.address)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};

    use axum::Router;
    use axum::routing::get;
    use k8s_openapi::jiff::Timestamp;
    use rustls::pki_types::pem::PemObject;
    use rustls::pki_types::{CertificateDer, ServerName};
    use rustls::{ClientConfig, RootCertStore};
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio_rustls::TlsConnector;

    use super::*;
    use crate::authority::Roots;

    const ASK: &[u8] = b"GET /a HTTP/1.1\r\nhost: operator\r\nconnection: close\r\n\r\n";

    async fn ask(address: SocketAddr, bundle: &str, name: &'static str) -> io::Result<String> {
        let mut roots = RootCertStore::empty();
        for certificate in CertificateDer::pem_slice_iter(bundle.as_bytes()) {
            roots.add(certificate.unwrap()).unwrap();
        }
        let builder = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()));
        let builder = builder.with_safe_default_protocol_versions().unwrap();
        let config = builder.with_root_certificates(roots).with_no_client_auth();
        let stream = TcpStream::connect(address).await?;
        let connector = TlsConnector::from(Arc::new(config));
        let mut stream = connector.connect(ServerName::try_from(name).unwrap(), stream).await?;
        stream.write_all(ASK).await?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer).await?;
        Ok(answer)
    }

    #[tokio::test]
    async fn who_trusts_our_authority_is_served_and_nobody_else() {
        let now = Timestamp::now().as_second();
        let (ours, others) = (Roots::renewed(None, now).unwrap(), Roots::renewed(None, now).unwrap());
        let current = Current::new(ours.serving("operator.rayherd.svc", now).unwrap().key);
        let count = Arc::new(AtomicU32::new(0));
        let counts = count.clone();
        let refused = move || {
            counts.fetch_add(1, Ordering::SeqCst);
        };
        let tls = Tls::listen("127.0.0.1:0".parse().unwrap(), current.clone(), refused).await.unwrap();
        let address = tls.address;
        let router = Router::new().route("/a", get(|| async { "served" }));
        tokio::spawn(async move { axum::serve(tls, router).await });

        let name = "operator.rayherd.svc";
        assert!(ask(address, &ours.bundle(), name).await.unwrap().ends_with("served"));
        let error = ask(address, &others.bundle(), name).await.unwrap_err().to_string();
        assert!(error.contains("invalid peer certificate"), "{error}");
        assert!(ask(address, &ours.bundle(), "other.rayherd.svc").await.is_err(), "another name");
        // no TLS at all
        let mut plain = TcpStream::connect(address).await.unwrap();
        plain.write_all(ASK).await.unwrap();
        let mut answer = Vec::new();
        let _ = plain.read_to_end(&mut answer).await;
        assert!(!String::from_utf8_lossy(&answer).contains("served"));
        for _ in 0..2000 {
            if count.load(Ordering::SeqCst) == 3 {
                break;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        assert_eq!(count.load(Ordering::SeqCst), 3, "two that do not trust us, one without TLS");
        // renewed while it serves
        current.set(others.serving("operator.rayherd.svc", now).unwrap().key);
        assert!(ask(address, &others.bundle(), name).await.unwrap().ends_with("served"));
        assert!(ask(address, &ours.bundle(), name).await.is_err());
    }
}
