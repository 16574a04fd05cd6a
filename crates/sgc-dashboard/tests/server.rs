//! Requests to the page's server: who sees nothing, and what is shown without a node.

#![allow(clippy::unwrap_used)]

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::sync::mpsc::channel;
use std::time::Duration;

use sgc_dashboard::{DashboardError, DashboardOptions, run};

/// Starts a page whose node does not run. Returns its address and its token.
fn start() -> (SocketAddr, String) {
    let options = DashboardOptions {
        listen: "127.0.0.1:0".parse().unwrap(),
        ..DashboardOptions::new("/nonexistent/sgc.sock".into())
    };
    let (send, url) = channel();
    std::thread::spawn(move || run(options, |url| send.send(url.to_owned()).unwrap()));
    let url = url.recv_timeout(Duration::from_secs(30)).unwrap();
    let (at, token) = url.strip_prefix("http://").unwrap().split_once("/#").unwrap();
    (at.parse().unwrap(), token.to_owned())
}

/// Sends a request with these lines behind the first. Returns the head and the body of the answer.
fn ask(at: SocketAddr, request: &str, lines: &str) -> (String, String) {
    let mut stream = TcpStream::connect(at).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    let text = format!("{request} HTTP/1.1\r\n{lines}connection: close\r\n\r\n");
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
        let refused = run(options, |url| panic!("{url}"));
        assert!(matches!(refused, Err(DashboardError::NotLoopback(_))), "{at}");
    }
}
