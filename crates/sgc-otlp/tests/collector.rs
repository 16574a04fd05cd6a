//! The client against collectors that answer, stall and misbehave.

#![allow(clippy::unwrap_used)]

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use http::header::{AUTHORIZATION, CONTENT_TYPE, HOST};
use http::{HeaderMap, HeaderValue};
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use rustls_pki_types::{CertificateDer, PrivateKeyDer};
use sgc_otlp::{BODY_BYTES_MAX, Client, Endpoint, Fault, REQUEST_MAX, TrustedRoots};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_rustls::TlsAcceptor;

fn endpoint(at: SocketAddr, is_encrypted: bool) -> Endpoint {
    let host = if is_encrypted { "localhost".to_owned() } else { at.ip().to_string() };
    let authority = format!("{host}:{}", at.port());
    Endpoint { is_encrypted, host, port: at.port(), authority, path: "/base/v1/metrics".to_owned() }
}

/// Reads a request of a few bytes. Returns its head and body.
async fn read_request<S: AsyncRead + Unpin>(stream: &mut S) -> (String, String) {
    let mut seen = Vec::new();
    loop {
        let mut part = [0; 4096];
        let read = stream.read(&mut part).await.unwrap();
        seen.extend_from_slice(&part[..read]);
        let text = String::from_utf8(seen.clone()).unwrap();
        if let Some((head, body)) = text.split_once("\r\n\r\n") {
            let length = head.to_ascii_lowercase().split("content-length: ").nth(1).unwrap().to_owned();
            if body.len() == length.lines().next().unwrap().parse::<usize>().unwrap() {
                return (head.to_owned(), body.to_owned());
            }
        }
        assert!(read > 0, "the request ends early");
    }
}

/// Answers one request with these bytes, and keeps the connection open. Returns the request.
async fn collector(answer: Vec<u8>) -> (SocketAddr, JoinHandle<(String, String)>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let at = listener.local_addr().unwrap();
    let task = tokio::spawn(async move {
        let (mut stream, _) = listener.accept().await.unwrap();
        let request = read_request(&mut stream).await;
        // A client that has enough leaves.
        let _ = stream.write_all(&answer).await;
        let _ = stream.read_u8().await;
        request
    });
    (at, task)
}

async fn push_to(at: SocketAddr, headers: HeaderMap) -> Result<String, Fault> {
    let client = Client::new(endpoint(at, false), TrustedRoots::System, "1.2.3").unwrap();
    client.push(b"metrics".to_vec(), headers).await?.judge(SystemTime::now())
}

#[tokio::test]
async fn request_has_the_headers_of_the_protocol_and_of_the_user() {
    let (at, task) = collector(b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n".to_vec()).await;
    let headers = HeaderMap::from_iter([
        (AUTHORIZATION, HeaderValue::from_static("Bearer secret")),
        (CONTENT_TYPE, HeaderValue::from_static("text/plain")),
        (HOST, HeaderValue::from_static("evil.example")),
    ]);
    assert_eq!(push_to(at, headers).await, Ok(String::new()));
    let (head, body) = task.await.unwrap();
    assert_eq!(body, "metrics");
    let mut lines: Vec<_> = head.lines().map(str::to_ascii_lowercase).collect();
    assert_eq!(lines.remove(0), "post /base/v1/metrics http/1.1");
    lines.sort();
    let expected = [
        "accept: application/x-protobuf".to_owned(),
        "authorization: bearer secret".to_owned(),
        "content-length: 7".to_owned(),
        "content-type: application/x-protobuf".to_owned(),
        format!("host: {at}"),
        "user-agent: sgc/1.2.3".to_owned(),
    ];
    assert_eq!(lines, expected);
}

#[tokio::test]
async fn redirect_is_reported_and_not_followed() {
    let elsewhere = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let location = format!("http://{}/v1/metrics", elsewhere.local_addr().unwrap());
    let answer = format!("HTTP/1.1 307 Moved\r\nlocation: {location}\r\ncontent-length: 0\r\n\r\n");
    let (at, _task) = collector(answer.into_bytes()).await;
    assert_eq!(push_to(at, HeaderMap::new()).await, Err(Fault::Redirected { status: 307, location }));
    let followed = tokio::time::timeout(Duration::from_millis(100), elsewhere.accept()).await;
    assert!(followed.is_err(), "nobody connects there");
}

#[tokio::test]
async fn endless_answers_are_cut() {
    let body = vec![b'x'; 4 * BODY_BYTES_MAX];
    for (status, refused) in [(200, false), (400, true)] {
        let mut answer =
            format!("HTTP/1.1 {status} X\r\ncontent-type: text/plain\r\ntransfer-encoding: chunked\r\n\r\n")
                .into_bytes();
        for chunk in body.chunks(1 << 14) {
            answer.extend_from_slice(format!("{:x}\r\n", chunk.len()).as_bytes());
            answer.extend_from_slice(chunk);
            answer.extend_from_slice(b"\r\n");
        }
        let (at, _task) = collector(answer).await;
        let begun = Instant::now();
        let fault = push_to(at, HeaderMap::new()).await.unwrap_err();
        assert_eq!(matches!(fault, Fault::Refused { status: 400, .. }), refused, "{fault}");
        assert_eq!(matches!(fault, Fault::NotOtlp { .. }), !refused, "{fault}");
        assert!(begun.elapsed() < REQUEST_MAX / 2, "nobody waits for the end of it");
    }
    let mut head = b"HTTP/1.1 200 OK\r\n".to_vec();
    head.extend(b"x: y\r\n".repeat(1 << 16));
    let (at, _task) = collector(head).await;
    assert!(matches!(push_to(at, HeaderMap::new()).await, Err(Fault::Broken { .. })));
}

#[tokio::test]
async fn connection_without_an_answer_is_a_fault() {
    let (at, _task) = collector(b"SSH-2.0-OpenSSH_9.2\r\n".to_vec()).await;
    assert!(matches!(push_to(at, HeaderMap::new()).await, Err(Fault::Broken { .. })));
    let free = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    assert!(matches!(push_to(free, HeaderMap::new()).await, Err(Fault::Unreachable { .. })));
}

#[tokio::test]
async fn collector_that_hangs_or_trickles_is_given_up() {
    let (silent, _task) = collector(Vec::new()).await;
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let trickling = listener.local_addr().unwrap();
    let task = tokio::spawn(async move {
        let (mut stream, _) = listener.accept().await.unwrap();
        let begin = b"HTTP/1.1 200 OK\r\ncontent-length: 60000\r\n\r\n";
        let _ = stream.write_all(begin).await;
        while stream.write_all(b"x").await.is_ok() {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    let timed_out = Err(Fault::TimedOut { within: REQUEST_MAX });
    let pushes = (push_to(silent, HeaderMap::new()), push_to(trickling, HeaderMap::new()));
    assert_eq!(tokio::join!(pushes.0, pushes.1), (timed_out.clone(), timed_out));
    // The connection is closed as well, or the writer would go on.
    tokio::time::timeout(Duration::from_secs(5), task).await.unwrap().unwrap();
}

/// A CA, and a server's certificate for `localhost` with its key.
fn certificates() -> (CertificateDer<'static>, CertificateDer<'static>, PrivateKeyDer<'static>) {
    let mut params = CertificateParams::new(Vec::new()).unwrap();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let ca = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
    let key = KeyPair::generate().unwrap();
    let server = CertificateParams::new(vec!["localhost".to_owned()]).unwrap().signed_by(&key, &ca).unwrap();
    (ca.der().clone(), server.der().clone(), PrivateKeyDer::Pkcs8(key.serialize_der().into()))
}

#[tokio::test]
async fn tls_trusts_the_given_roots_alone() {
    async fn serve<S: AsyncRead + AsyncWrite + Unpin>(mut stream: S) {
        read_request(&mut stream).await;
        stream.write_all(b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n").await.unwrap();
        let _ = stream.read_u8().await;
    }
    let (ca, server, key) = certificates();
    let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
    let config = rustls::ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(vec![server], key)
        .unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let at = listener.local_addr().unwrap();
    let task = tokio::spawn(async move {
        let acceptor = TlsAcceptor::from(Arc::new(config));
        loop {
            let (stream, _) = listener.accept().await.unwrap();
            if let Ok(stream) = acceptor.accept(stream).await {
                serve(stream).await;
            }
        }
    });
    let push = async |roots: TrustedRoots| {
        // `localhost` may lead to ::1 first, where nobody listens.
        let client = Client::new(endpoint(at, true), roots, "1.2.3").unwrap();
        client.push(b"metrics".to_vec(), HeaderMap::new()).await
    };
    assert_eq!(push(TrustedRoots::Certificates(vec![ca])).await.unwrap().status, 200);
    let (other, ..) = certificates();
    let refused = push(TrustedRoots::Certificates(vec![other])).await.unwrap_err();
    assert!(matches!(&refused, Fault::Tls { reason } if reason.contains("certificate")), "{refused}");
    let none = Client::new(endpoint(at, true), TrustedRoots::Certificates(Vec::new()), "1.2.3");
    assert!(matches!(none, Err(Fault::Tls { .. })));
    task.abort();
}
