//! `miniupnpd` as the gateway of the robot's network, with the rules of nftables that it fills.

use std::fs;
use std::process::{Child, Stdio};
use std::sync::Arc;

use sgc_testkit::netsim::Namespace;

use crate::lab::Lab;
use crate::support::{eventually, say};

/// The public address of the gateway: `miniupnpd` maps no port at a private or documentation address.
pub(crate) const OUTSIDE: &str = "11.10.1.2";
/// Where `miniupnpd` takes requests by HTTP.
const HTTP_PORT: u16 = 5000;

/// The protocols that the gateway knows.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Speaks {
    /// PCP and NAT-PMP, with this longest lifetime in seconds.
    Pcp(u32),
    /// NAT-PMP alone: packets of PCP's version are lost.
    NatPmp,
    /// UPnP-IGD.
    Upnp,
}

/// The gateway's service. Dropping it ends it.
pub(crate) struct Igd {
    near: Arc<Namespace>,
    config: String,
    tables: String,
    process: Option<Child>,
}

impl Igd {
    /// Returns `true` if the program is installed.
    pub(crate) fn is_installed() -> bool {
        let found =
            ["/usr/sbin/miniupnpd", "/usr/bin/miniupnpd"].iter().any(|path| fs::exists(path).unwrap());
        if !found {
            say("NO MINIUPNPD (scripts/install-deps.sh test): port mappings are not tested");
        }
        found
    }

    /// Gives the robot's gateway a public address and starts the service.
    pub(crate) fn start(lab: &Lab, speaks: Speaks) -> Self {
        let near = lab.near.clone();
        near.ip(&["address", "replace", &format!("{OUTSIDE}/24"), "dev", "wan"]).unwrap();
        near.ip(&["address", "del", "10.10.1.2/24", "dev", "wan"]).unwrap();
        lab.cloud.ip(&["address", "replace", "11.10.1.1/24", "dev", "near"]).unwrap();
        near.ip(&["route", "replace", "default", "via", "11.10.1.1"]).unwrap();
        let path = |name: &str| lab.path(name).to_str().unwrap().to_owned();
        let (config, tables) = (path("miniupnpd.conf"), path("miniupnpd.nft"));
        let (pmp, upnp, lifetime) = match speaks {
            Speaks::Pcp(lifetime) => ("yes", "no", lifetime),
            Speaks::NatPmp => ("yes", "no", 86_400),
            Speaks::Upnp => ("no", "yes", 86_400),
        };
        let text = format!(
            "ext_ifname=wan\nlistening_ip=lan\nhttp_port={HTTP_PORT}\nenable_natpmp={pmp}\nenable_upnp={upnp}\n\
             min_lifetime=1\nmax_lifetime={lifetime}\nsecure_mode=yes\nsystem_uptime=no\n\
             upnp_table_name=igd\nupnp_nat_table_name=igd\nupnp_forward_chain=forwarded\nupnp_nat_chain=mapped\n\
             upnp_nat_postrouting_chain=sent\nuuid=2f1c3e0a-8a52-4b7e-9d53-6f1f0d0f7a11\nipv6_disable=yes\n\
             allow 1024-65535 10.1.0.0/24 1024-65535\ndeny 0-65535 0.0.0.0/0 0-65535\n"
        );
        fs::write(&config, text).unwrap();
        // It drops the packets that do not begin with the version of NAT-PMP, 0.
        let old = match speaks {
            Speaks::NatPmp => {
                "chain old { type filter hook input priority 0; udp dport 5351 @th,64,8 != 0 drop; }\n"
            }
            Speaks::Pcp(_) | Speaks::Upnp => "",
        };
        let rules = format!(
            "table inet igd\ndelete table inet igd\ntable inet igd {{\n\
             chain forwarded {{ }}\nchain mapped {{ }}\nchain sent {{ }}\n{old}\
             chain forward {{ type filter hook forward priority 0; jump forwarded; }}\n\
             chain prerouting {{ type nat hook prerouting priority -100; jump mapped; }}\n\
             chain postrouting {{ type nat hook postrouting priority 100; jump sent; }}\n}}\n"
        );
        fs::write(&tables, rules).unwrap();
        let mut igd = Self { near, config, tables, process: None };
        igd.restart();
        igd
    }

    /// Ends the service, forgets all mappings, and starts it again.
    pub(crate) fn restart(&mut self) {
        self.end();
        self.near.run("nft", &["-f", &self.tables]).unwrap();
        assert_eq!(self.mapped(), [0; 0]);
        let pid = self.config.clone() + ".pid";
        let mut command = self.near.command("miniupnpd");
        command.args(["-d", "-f", &self.config, "-P", &pid]).stdin(Stdio::null());
        let log = fs::File::create(self.config.clone() + ".log").unwrap();
        command.stdout(log.try_clone().unwrap()).stderr(log);
        self.process = Some(command.spawn().unwrap());
        eventually("the gateway serves", || {
            let sockets = self.near.run("ss", &["-Hlnut"]).unwrap();
            sockets.contains(":5351 ") || sockets.contains(":1900 ") && sockets.contains(":5000 ")
        });
    }

    fn end(&mut self) {
        if let Some(mut process) = self.process.take() {
            process.kill().unwrap();
            process.wait().unwrap();
        }
    }

    /// Returns the external ports that are mapped to the robot.
    pub(crate) fn mapped(&self) -> Vec<u16> {
        let rules = self.near.run("nft", &["list", "chain", "inet", "igd", "mapped"]).unwrap();
        let port = |line: &str| {
            let (_, rest) = line.split_once("dport ").filter(|_| line.contains("10.1.0.2"))?;
            rest.split_whitespace().next()?.parse().ok()
        };
        rules.lines().filter_map(port).collect()
    }
}

impl Drop for Igd {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let log = fs::read_to_string(self.config.clone() + ".log").unwrap_or_default();
            say(&format!("miniupnpd said:\n{log}"));
        }
        self.end();
    }
}
