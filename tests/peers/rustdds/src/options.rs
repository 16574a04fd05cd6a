//! The command line of `../../README.md`.

use std::time::Duration;

#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Role {
    Pub,
    Sub,
    Client,
    Server,
}

pub struct Options {
    pub role: Role,
    pub domain: u16,
    pub topic: String,
    pub kind: String,
    pub count: u64,
    pub timeout: Duration,
    pub reliable: bool,
    pub transient_local: bool,
    pub depth: usize,
    pub localhost: bool,
    pub verbose: bool,
    pub rate: f64,
    pub size: usize,
    pub start: u64,
    pub wait_matched: usize,
    pub wait_go: bool,
    pub hold: Duration,
    pub linger: Duration,
}

impl Options {
    pub fn parse(mut args: impl Iterator<Item = String>) -> Result<Self, String> {
        let role = match args.next().as_deref() {
            Some("pub") => Role::Pub,
            Some("sub") => Role::Sub,
            Some("client") => Role::Client,
            Some("server") => Role::Server,
            other => return Err(format!("no such role: {other:?}")),
        };
        let mut options = Self {
            role,
            domain: 0,
            topic: "/chatter".into(),
            kind: "string".into(),
            count: 0,
            timeout: Duration::from_secs(60),
            reliable: true,
            transient_local: false,
            depth: 10,
            localhost: false,
            verbose: false,
            rate: 10.0,
            size: 0,
            start: 0,
            wait_matched: 1,
            wait_go: false,
            hold: Duration::ZERO,
            linger: Duration::ZERO,
        };
        while let Some(name) = args.next() {
            match name.as_str() {
                "--reliable" => options.reliable = true,
                "--best-effort" => options.reliable = false,
                "--transient-local" => options.transient_local = true,
                "--localhost" => options.localhost = true,
                "--verbose" => options.verbose = true,
                "--wait-go" => options.wait_go = true,
                // RustDDS has no shared memory, and needs no settings for large messages.
                "--udp-only" | "--large" => {}
                name => {
                    let value = args.next().ok_or_else(|| format!("{name} without a value"))?;
                    options.set(name, value)?;
                }
            }
        }
        Ok(options)
    }

    fn set(&mut self, name: &str, value: String) -> Result<(), String> {
        fn number<T: std::str::FromStr>(value: &str) -> Result<T, String> {
            value.parse().map_err(|_| format!("no number: {value}"))
        }
        let seconds = |value: &str| {
            Duration::try_from_secs_f64(number(value)?).map_err(|_| format!("no time: {value}"))
        };
        match name {
            "--domain" => self.domain = number(&value)?,
            "--topic" => self.topic = value,
            "--type" => self.kind = value,
            "--count" => self.count = number(&value)?,
            "--timeout" => self.timeout = seconds(&value)?,
            "--depth" => self.depth = number(&value)?,
            "--rate" => self.rate = number(&value)?,
            "--size" => self.size = number(&value)?,
            "--start" => self.start = number(&value)?,
            "--wait-matched" => self.wait_matched = number(&value)?,
            "--hold" => self.hold = seconds(&value)?,
            "--linger" => self.linger = seconds(&value)?,
            other => return Err(format!("no such option: {other}")),
        }
        Ok(())
    }
}
