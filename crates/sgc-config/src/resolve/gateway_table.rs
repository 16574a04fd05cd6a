//! Resolves the draft of `[gateway]`.

use sgc_gateway::{Anonymous, Scope};
use sgc_trust::CertificateName;

use super::{LISTEN_MAX, Resolver, unknown_word};
use crate::draft::{GatewayClientDraft, GatewayDraft, PartnerDraft, WithOrigin};
use crate::error::{Mistake, Origin};
use crate::gateway::{
    GATEWAY_CLIENTS_MAX, GATEWAY_NAMES_MAX, GatewayClientConfig, GatewayConfig, GatewayTls, GatewayUrl,
    ORIGINS_MAX,
};
use crate::names;

impl Resolver<'_> {
    pub(super) fn gateway(&mut self, written: &GatewayDraft, partners: &[PartnerDraft]) -> GatewayConfig {
        let default = GatewayConfig::default();
        let plain = written.plain.as_ref().is_some_and(|plain| plain.value);
        let listen = self.gateway_listen(written, plain);
        let tls = self.gateway_tls(written, &listen);
        let names = self.gateway_names(written);
        let bounds = (1, GatewayConfig::CLIENTS_MAX_MAX);
        let clients_max =
            written.clients_max.as_ref().and_then(|n| self.number(n, "a number of clients", bounds));
        let bounds = (GatewayConfig::CLIENT_BYTES_MIN, GatewayConfig::CLIENT_BYTES_MAX);
        let client_bytes_max = written
            .client_bytes_max
            .as_ref()
            .and_then(|size| self.keep(size, |key, value| names::size(key, value, bounds)));
        if let Some(over) = written.clients.get(GATEWAY_CLIENTS_MAX) {
            let origin = over.origin.clone();
            self.check_count(&origin, "[[gateway.client]]", written.clients.len(), GATEWAY_CLIENTS_MAX);
        }
        let clients = written.clients.iter().take(GATEWAY_CLIENTS_MAX);
        GatewayConfig {
            listen,
            tls,
            names,
            anonymous: written
                .anonymous
                .as_ref()
                .and_then(|word| self.keep(word, anonymous))
                .unwrap_or_default(),
            origins: self.addresses(&written.origins, names::page_origin, ORIGINS_MAX),
            plain,
            clients_max: clients_max.and_then(|n| n.try_into().ok()).unwrap_or(default.clients_max),
            client_bytes_max: client_bytes_max.unwrap_or(default.client_bytes_max),
            clients: clients.filter_map(|client| self.gateway_client(client, partners)).collect(),
        }
    }

    fn gateway_listen(&mut self, written: &GatewayDraft, plain: bool) -> Vec<GatewayUrl> {
        let Some(listen) = &written.listen else {
            let usual = GatewayConfig::default_listen();
            if usual.is_empty() {
                let origin = written.origin.clone().unwrap_or(Origin::Arguments);
                self.record(&origin, Mistake::GatewayNotBuilt);
            }
            return usual;
        };
        if listen.value.is_empty() {
            let example = "listen = [\"ws://127.0.0.1:9090\"], or leave it out to listen at the usual ports of this host";
            self.record(&listen.origin, Mistake::Empty { key: listen.key, example });
        }
        let valid = self.addresses(&listen.value, names::gateway_listen, LISTEN_MAX);
        for one in listen.value.iter().filter(|_| !plain) {
            let Ok(url) = one.value.parse::<GatewayUrl>() else { continue };
            if url.is_open() {
                self.record(
                    &one.origin,
                    Mistake::GatewayOpen { key: one.key, value: one.value.clone(), url },
                );
            }
        }
        valid
    }

    fn gateway_tls(&mut self, written: &GatewayDraft, listen: &[GatewayUrl]) -> Option<GatewayTls> {
        let (certificate, key) = match (&written.certificate, &written.key) {
            (Some(certificate), Some(key)) => (certificate, key),
            (Some(alone), None) => {
                self.record(&alone.origin, Mistake::Alone { key: alone.key, other: "key" });
                return None;
            }
            (None, Some(alone)) => {
                self.record(&alone.origin, Mistake::Alone { key: alone.key, other: "certificate" });
                return None;
            }
            (None, None) => return None,
        };
        if !listen.is_empty() && !listen.iter().any(|url| url.scheme.is_encrypted()) {
            self.record(&certificate.origin, Mistake::CertificateUnused { key: certificate.key });
        }
        let files = (self.path(certificate, "\"robot.pem\""), self.path(key, "\"robot.key\""));
        let (Some(chain_path), Some(key_path)) = files else { return None };
        if let Some(checks) = self.checks {
            let found = [
                (certificate, (checks.chain)(certificate.key, &chain_path)),
                (key, (checks.private_key)(key.key, &key_path)),
            ];
            for (written, found) in found {
                let _ = found.map_err(|mistake| self.record(&written.origin, mistake));
            }
        }
        Some(GatewayTls { certificate: chain_path, key: key_path })
    }

    fn gateway_names(&mut self, written: &GatewayDraft) -> Vec<CertificateName> {
        let Some(names) = &written.names else { return Vec::new() };
        if written.certificate.is_some() {
            self.record(&names.origin, Mistake::NamesUnused { key: names.key });
        }
        self.addresses(&names.value, names::certificate_name, GATEWAY_NAMES_MAX)
    }

    fn gateway_client(
        &mut self,
        written: &GatewayClientDraft,
        partners: &[PartnerDraft],
    ) -> Option<GatewayClientConfig> {
        let who = written.who.as_ref().map(|who| {
            if who.value.is_empty() {
                let example = "who = [\"desk\", \"group:operators\"]";
                self.record(&who.origin, Mistake::Empty { key: who.key, example });
            }
            self.recipients(who, None, partners)
        });
        let errors = self.errors.len();
        let mut patterns = |list: &[WithOrigin<String>]| -> Vec<String> {
            list.iter().filter_map(|one| self.keep(one, names::pattern)).collect()
        };
        let scope = Scope {
            subscribe: patterns(&written.subscribe),
            publish: patterns(&written.publish),
            call: patterns(&written.call),
            serve: patterns(&written.serve),
        };
        let is_judged = self.errors.len() == errors && !written.is_broken;
        if let Err(fault) = scope.check()
            && is_judged
        {
            self.record(&written.origin, Mistake::Scope { fault });
        }
        who.map(|who| GatewayClientConfig { who, scope })
    }
}

fn anonymous(key: &'static str, value: &str) -> Result<Anonymous, Mistake> {
    match value {
        "local" => Ok(Anonymous::Local),
        "none" => Ok(Anonymous::None),
        "all" => Ok(Anonymous::All),
        _ => Err(unknown_word(key, value, &["local", "none", "all"])),
    }
}
