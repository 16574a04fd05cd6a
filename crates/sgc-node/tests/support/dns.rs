//! A DNS server on the loopback interface with records of the test.

#![allow(clippy::unwrap_used, dead_code, unreachable_pub)]

use std::collections::BTreeMap;
use std::net::{SocketAddr, UdpSocket};
use std::sync::{Arc, Mutex};

const A: u16 = 1;
const SRV: u16 = 33;
const NXDOMAIN: u16 = 3;

/// A record's type and data.
#[derive(Clone)]
pub struct Record(u16, Vec<u8>);

impl Record {
    pub fn srv(priority: u16, weight: u16, port: u16, target: &str) -> Self {
        let numbers = [priority, weight, port].into_iter().flat_map(u16::to_be_bytes);
        Self(SRV, numbers.chain(name(target)).collect())
    }
}

type Zone = Arc<Mutex<BTreeMap<String, Vec<Record>>>>;

/// The server, which ends with the process.
pub struct DnsServer {
    pub addr: SocketAddr,
    zone: Zone,
}

impl DnsServer {
    pub fn start() -> Self {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let server = Self { addr: socket.local_addr().unwrap(), zone: Zone::default() };
        let zone = server.zone.clone();
        std::thread::spawn(move || {
            let mut query = [0; 4096];
            while let Ok((length, from)) = socket.recv_from(&mut query) {
                if let Some(answer) = answer(&query[..length], &zone) {
                    let _ = socket.send_to(&answer, from);
                }
            }
        });
        server
    }

    /// Sets the records of a name, which ends with a dot.
    pub fn set(&self, name: &str, records: Vec<Record>) {
        self.zone.lock().unwrap().insert(name.to_owned(), records);
    }

    pub fn set_host(&self, name: &str, ip: [u8; 4]) {
        self.set(name, vec![Record(A, ip.to_vec())]);
    }
}

fn name(text: &str) -> Vec<u8> {
    let labels = text.trim_end_matches('.').split('.').filter(|label| !label.is_empty());
    let mut bytes: Vec<u8> = labels.flat_map(|l| [&[l.len() as u8], l.as_bytes()].concat()).collect();
    bytes.push(0);
    bytes
}

/// Builds an answer (RFC 1035, 4): header, the question unchanged, and records whose names point to it.
fn answer(query: &[u8], zone: &Zone) -> Option<Vec<u8>> {
    let mut at = 12;
    let mut asked = String::new();
    while *query.get(at)? != 0 {
        let length = usize::from(query[at]);
        asked += &String::from_utf8_lossy(query.get(at + 1..at + 1 + length)?).to_ascii_lowercase();
        asked.push('.');
        at += 1 + length;
    }
    let question = query.get(12..at + 5)?;
    let kind = u16::from_be_bytes([query[at + 1], query[at + 2]]);
    let known = zone.lock().unwrap().get(&asked).cloned();
    let records: Vec<_> = known.iter().flatten().filter(|record| record.0 == kind).collect();
    let flags = 0x8580 | if known.is_some() { 0 } else { NXDOMAIN };
    let mut answer = query[..2].to_vec();
    for number in [flags, 1, records.len() as u16, 0, 0] {
        answer.extend(number.to_be_bytes());
    }
    answer.extend(question);
    for Record(kind, data) in records {
        answer.extend([0xc0, 12]);
        answer.extend(kind.to_be_bytes());
        answer.extend([0, 1, 0, 0, 0, 1]);
        answer.extend((data.len() as u16).to_be_bytes());
        answer.extend(data);
    }
    Some(answer)
}
