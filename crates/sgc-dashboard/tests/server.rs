//! Requests to the page's server: tokens and their rights, hostile requests, and documents without a node.

#![allow(clippy::unwrap_used)]

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use sgc_dashboard::{DashboardError, DashboardOptions, PageUrls, Revoke, run};

fn split(url: &str) -> (SocketAddr, String) {
    let (at, token) = url.strip_prefix("http://").unwrap().split_once("/#").unwrap();
    (at.parse().unwrap(), token.to_owned())
}

fn start_with(revoke: Option<Revoke>) -> PageUrls {
    let options = DashboardOptions {
        listen: "127.0.0.1:0".parse().unwrap(),
        revoke,
        ..DashboardOptions::new("/nonexistent/sgc.sock".into())
    };
    let (send, urls) = channel();
    std::thread::spawn(move || run(options, |urls| send.send(urls.clone()).unwrap()));
    urls.recv_timeout(Duration::from_secs(30)).unwrap()
}

/// Starts a page whose node does not run. Returns its address and its token.
fn start() -> (SocketAddr, String) {
    let urls = start_with(None);
    assert_eq!(urls.operate, None);
    split(&urls.look)
}

/// A page that may revoke, and the nodes that it revoked.
struct Operating {
    at: SocketAddr,
    look: String,
    operate: String,
    revoked: Arc<Mutex<Vec<String>>>,
}

impl Operating {
    /// Starts one whose authority refuses every node but `arm`.
    fn start() -> Self {
        let revoked = Arc::<Mutex<Vec<String>>>::default();
        let noted = revoked.clone();
        let revoke: Revoke = Box::new(move |_, node| {
            if node != "arm" {
                return Err(format!("keeper refuses: there is no {node}; see `sgc fleet list`"));
            }
            noted.lock().unwrap().push(node.to_owned());
            Ok(7)
        });
        let urls = start_with(Some(revoke));
        let ((at, look), (_, operate)) = (split(&urls.look), split(&urls.operate.unwrap()));
        Self { at, look, operate, revoked }
    }

    /// Returns the headers that the page sends with a token.
    fn headers(&self, token: &str) -> Vec<String> {
        let at = self.at;
        vec![
            format!("host: {at}"),
            format!("authorization: Bearer {token}"),
            format!("origin: http://{at}"),
            "sec-fetch-site: same-origin".to_owned(),
            "content-type: application/json".to_owned(),
        ]
    }

    fn post(&self, headers: &[String], body: &str) -> (String, String) {
        let lines: String = headers.iter().map(|line| format!("{line}\r\n")).collect();
        let lines = format!("{lines}content-length: {}\r\n", body.len());
        ask_with(self.at, "POST /api/revoke", &lines, body)
    }

    /// Asserts that a request with other headers than the page's, or another body, revokes nothing.
    fn assert_refused(&self, headers: &[String], body: &str, status: u16) {
        let (head, answer) = self.post(headers, body);
        assert!(head.starts_with(&format!("HTTP/1.1 {status}")), "{headers:?} {body}: {head}\n{answer}");
        assert!(
            !answer.is_empty() && self.revoked.lock().unwrap().is_empty(),
            "{headers:?} {body}: {answer}"
        );
    }
}

const ARM: &str = r#"{"node":"arm"}"#;

/// Sends a request with these lines behind the first. Returns the head and the body of the answer.
fn ask(at: SocketAddr, request: &str, lines: &str) -> (String, String) {
    ask_with(at, request, lines, "")
}

fn ask_with(at: SocketAddr, request: &str, lines: &str, body: &str) -> (String, String) {
    let mut stream = TcpStream::connect(at).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    let text = format!("{request} HTTP/1.1\r\n{lines}connection: close\r\n\r\n{body}");
    stream.write_all(text.as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    (head.to_owned(), body.to_owned())
}

#[test]
fn documents_need_the_token_and_the_page_tells_nothing() {
    let (at, token) = start();
    let host = format!("host: {at}\r\n");
    for path in ["/", "/app.js", "/app.css"] {
        let (head, body) = ask(at, &format!("GET {path}"), &host);
        assert!(head.starts_with("HTTP/1.1 200") && !body.contains(&token), "{path}: {head}");
        assert!(head.contains("content-security-policy: default-src 'none'; script-src 'self'"), "{head}");
        assert!(
            head.contains("x-content-type-options: nosniff") && !head.contains("access-control"),
            "{head}"
        );
    }
    let (_, page) = ask(at, "GET /", &host);
    assert!(!page.contains("<script>") && !page.contains(" style=") && !page.contains("http"), "{page}");
    let first = if token.starts_with('0') { "1" } else { "0" };
    let wrong = format!("{first}{}", &token[1..]);
    for lines in [
        host.clone(),
        format!("{host}authorization: Bearer {wrong}\r\n"),
        format!("{host}authorization: Bearer \r\n"),
        format!("{host}authorization: {token}\r\n"),
        format!("{host}cookie: {token}\r\n"),
    ] {
        for path in ["/api/fleet", "/api/why?node=arm&interface=/a", "/api/x"] {
            let (head, _) = ask(at, &format!("GET {path}"), &lines);
            assert!(head.starts_with("HTTP/1.1 401"), "{path} {lines}: {head}");
        }
    }
}

/// Names of nodes and topics come from other machines.
#[test]
fn page_sets_texts_and_parses_no_markup() {
    let (at, _) = start();
    let (_, script) = ask(at, "GET /app.js", &format!("host: {at}\r\n"));
    for way in
        ["innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "srcdoc", "DOMParser"]
    {
        assert!(!script.contains(way), "{way}");
    }
    assert!(script.contains("textContent"));
}

#[test]
fn page_of_another_site_cannot_ask() {
    let (at, token) = start();
    let permitted = format!("authorization: Bearer {token}\r\n");
    // Its name leads here (DNS rebinding).
    let (head, _) = ask(at, "GET /api/fleet", &format!("host: evil.example\r\n{permitted}"));
    assert!(head.starts_with("HTTP/1.1 421"), "{head}");
    for method in ["POST", "PUT", "DELETE", "OPTIONS"] {
        let (head, _) = ask(at, &format!("{method} /api/fleet"), &format!("host: {at}\r\n{permitted}"));
        assert!(head.starts_with("HTTP/1.1 405"), "{head}");
    }
}

#[test]
fn without_a_node_the_documents_say_so() {
    let (at, token) = start();
    let lines = format!("host: {at}\r\nauthorization: Bearer {token}\r\n");
    let (head, body) = ask(at, "GET /api/fleet?after=0", &lines);
    assert!(head.starts_with("HTTP/1.1 200"), "{head}");
    let document: serde_json::Value = serde_json::from_str(&body).unwrap();
    assert!(document["view"]["seq"].as_u64().unwrap() > 0 && document["age_ms"].is_null(), "{document}");
    assert!(document["view"]["error"].as_str().unwrap().contains("no node runs"), "{document}");
    let (_, body) = ask(at, "GET /api/why?node=arm&interface=%2Fa", &lines);
    assert!(body.contains("no node runs") && body.contains("\"steps\":[]"), "{body}");
    for path in ["/api/why", "/api/why?node=arm"] {
        let (head, _) = ask(at, &format!("GET {path}"), &lines);
        assert!(head.starts_with("HTTP/1.1 400"), "{head}");
    }
    for path in ["/api/x", "/x", "/page/index.html", "/../Cargo.toml"] {
        let (head, _) = ask(at, &format!("GET {path}"), &lines);
        assert!(head.starts_with("HTTP/1.1 404"), "{path}: {head}");
    }
}

#[test]
fn address_that_others_reach_is_refused() {
    for at in ["0.0.0.0:0", "192.0.2.1:7480", "[::]:0"] {
        let options = DashboardOptions {
            listen: at.parse().unwrap(),
            ..DashboardOptions::new("/nonexistent/sgc.sock".into())
        };
        let refused = run(options, |url| panic!("{url:?}"));
        assert!(matches!(refused, Err(DashboardError::NotLoopback(_))), "{at}");
    }
}

#[test]
fn page_revokes_with_the_token_for_operations() {
    let page = Operating::start();
    assert_ne!(page.look, page.operate);
    for (token, may) in [(&page.look, false), (&page.operate, true)] {
        let lines = format!("host: {}\r\nauthorization: Bearer {token}\r\n", page.at);
        let (_, document) = ask(page.at, "GET /api/fleet?after=0", &lines);
        assert!(document.contains(&format!("\"may_operate\":{may}")), "{document}");
    }
    // The authority's refusal comes with its remedy.
    let (head, body) = page.post(&page.headers(&page.operate), r#"{"node":"ghost"}"#);
    assert!(head.starts_with("HTTP/1.1 409"), "{head}");
    assert_eq!(body, "keeper refuses: there is no ghost; see `sgc fleet list`\n");
    let (head, body) = page.post(&page.headers(&page.operate), ARM);
    assert!(head.starts_with("HTTP/1.1 200") && !head.contains("access-control"), "{head}");
    assert_eq!(
        (body.as_str(), &page.revoked.lock().unwrap()[..]),
        (r#"{"list":7}"#, &["arm".to_owned()][..])
    );
}

#[test]
fn token_that_only_looks_revokes_nothing_whatever_is_sent() {
    let page = Operating::start();
    for body in [ARM, "", "{}", &"x".repeat(4000)] {
        page.assert_refused(&page.headers(&page.look), body, 403);
    }
    // Nor does any token of a page without operations.
    let (at, token) = start();
    let reading = Operating { at, look: token.clone(), operate: token.clone(), revoked: Arc::default() };
    reading.assert_refused(&reading.headers(&token), ARM, 403);
    let lines = format!("host: {at}\r\nauthorization: Bearer {token}\r\n");
    let (_, document) = ask(at, "GET /api/fleet?after=0", &lines);
    assert!(document.contains("\"may_operate\":false"), "{document}");
}

#[test]
fn request_that_the_page_did_not_send_revokes_nothing() {
    let page = Operating::start();
    let own = page.headers(&page.operate);
    let without = |name: &str| -> Vec<_> {
        own.iter().filter(|line| !line.starts_with(&format!("{name}:"))).cloned().collect()
    };
    let with = |name: &str, value: &str| {
        let mut headers = without(name);
        headers.push(format!("{name}: {value}"));
        headers
    };
    let (at, port) = (page.at, page.at.port());
    for (headers, status) in [
        (without("authorization"), 401),
        (with("authorization", &format!("Bearer {}", "0".repeat(32))), 401),
        (with("authorization", &page.operate), 401),
        (without("origin"), 403),
        (with("origin", "null"), 403),
        (with("origin", "http://evil.example"), 403),
        (with("origin", &format!("https://{at}")), 403),
        (with("origin", &format!("http://localhost:{port}")), 403),
        (with("origin", &format!("http://{at}.evil.example")), 403),
        (with("origin", &format!("http://127.0.0.1:{}", port.wrapping_add(1))), 403),
        ([own.clone(), vec!["origin: http://evil.example".to_owned()]].concat(), 403),
        (with("sec-fetch-site", "cross-site"), 403),
        (with("sec-fetch-site", "same-site"), 403),
        (with("sec-fetch-site", "none"), 403),
        (with("host", "evil.example"), 421),
        (without("host"), 403),
        (without("content-type"), 415),
        (with("content-type", "text/plain"), 415),
        (with("content-type", "application/x-www-form-urlencoded"), 415),
    ] {
        page.assert_refused(&headers, ARM, status);
    }
    for (body, status) in [
        ("", 400),
        ("[]", 400),
        ("{}", 400),
        ("{\"node\":1}", 400),
        ("{\"node\":\"arm\",\"more\":1}", 400),
        ("{\"node\":\"arm\"}{\"node\":\"arm\"}", 400),
        ("\u{0}", 400),
        (&format!("{{\"node\":\"arm\"{}}}", " ".repeat(1000)), 413),
    ] {
        page.assert_refused(&own, body, status);
    }
    // A browser that sends no Fetch Metadata names the origin all the same.
    let (head, _) = page.post(&without("sec-fetch-site"), ARM);
    assert!(head.starts_with("HTTP/1.1 200"), "{head}");
}

#[test]
fn post_is_taken_at_one_place_and_no_other_method_is() {
    let page = Operating::start();
    let lines: String = page.headers(&page.operate).iter().map(|line| format!("{line}\r\n")).collect();
    let lines = format!("{lines}content-length: {}\r\n", ARM.len());
    for request in [
        "POST /api/fleet",
        "POST /api/revoke/",
        "POST /api/revoke/arm",
        "POST /",
        "PUT /api/revoke",
        "PATCH /api/revoke",
        "DELETE /api/revoke",
        "OPTIONS /api/revoke",
        "TRACE /api/revoke",
    ] {
        let (head, _) = ask_with(page.at, request, &lines, ARM);
        assert!(head.starts_with("HTTP/1.1 405"), "{request}: {head}");
    }
    let (head, _) = ask_with(page.at, "GET /api/revoke?node=arm", &lines, ARM);
    assert!(head.starts_with("HTTP/1.1 404"), "{head}");
    assert!(page.revoked.lock().unwrap().is_empty());
}

/// A body that is announced and does not come ends with its time, and one without length is cut off at the bound.
#[test]
fn body_that_never_ends_is_not_waited_for() {
    let page = Operating::start();
    let head: String = page.headers(&page.operate).iter().map(|line| format!("{line}\r\n")).collect();
    let mut chunked = TcpStream::connect(page.at).unwrap();
    chunked.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    let text = format!("POST /api/revoke HTTP/1.1\r\n{head}transfer-encoding: chunked\r\n\r\n");
    chunked.write_all(text.as_bytes()).unwrap();
    chunked.write_all(format!("1000\r\n{}\r\n", " ".repeat(0x1000)).as_bytes()).unwrap();
    let mut answer = [0; 12];
    chunked.read_exact(&mut answer).unwrap();
    assert_eq!(&answer, b"HTTP/1.1 413");
    let mut waiting = TcpStream::connect(page.at).unwrap();
    waiting.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    let text = format!("POST /api/revoke HTTP/1.1\r\n{head}content-length: 14\r\n\r\n{{");
    waiting.write_all(text.as_bytes()).unwrap();
    waiting.read_exact(&mut answer).unwrap();
    assert_eq!(&answer, b"HTTP/1.1 408");
    assert!(page.revoked.lock().unwrap().is_empty());
}

#[test]
fn second_operation_waits_for_no_place() {
    let (begun, begins) = channel();
    let (end, ends) = channel::<()>();
    let (begun, ends) = (Mutex::new(begun), Mutex::new(ends));
    let revoke: Revoke = Box::new(move |_, _| {
        begun.lock().unwrap().send(()).unwrap();
        ends.lock().unwrap().recv().unwrap();
        Ok(1)
    });
    let urls = start_with(Some(revoke));
    let (at, operate) = split(&urls.operate.unwrap());
    let page = Arc::new(Operating { at, look: String::new(), operate, revoked: Arc::default() });
    let first = {
        let page = page.clone();
        std::thread::spawn(move || page.post(&page.headers(&page.operate), ARM))
    };
    begins.recv_timeout(Duration::from_secs(30)).unwrap();
    page.assert_refused(&page.headers(&page.operate), ARM, 503);
    end.send(()).unwrap();
    assert!(first.join().unwrap().0.starts_with("HTTP/1.1 200"));
}
