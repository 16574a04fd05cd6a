//! The URLs of one router: order of attempts, parallel attempts, and memory of the URL that worked.
//!
//! It dials nothing. The caller passes the targets and a function that dials.

use std::collections::BTreeMap;
use std::future::Future;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use sgc_config::{RouterUrl, WAYS_MAX};
use sgc_sync::lock;
use sgc_transport::{LinkUrl, Scheme};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until};
use tracing::{debug, warn};

use crate::state;

/// Time after which a silent URL gets a parallel attempt at the next. It covers two round trips of a bad link around
/// the world, and is short enough that a node without UDP is up within 3 s.
pub(crate) const SILENT_AFTER: Duration = Duration::from_millis(700);
/// Longest wait for silent URLs once all were tried and one has failed. A failed URL may work again soon, for example
/// after a restart of the router, so it has to be tried again.
const SILENT_MAX: Duration = Duration::from_millis(2500);
/// File below the state directory that remembers working URLs.
const FILE: &str = "ways";
/// Most routers that are remembered, and the most bytes of the file.
const KEPT_MAX: usize = 64;
const FILE_BYTES_MAX: u64 = 64 << 10;

/// Groups the user's entries by router, keeping their order. Entries of one host with different transports are one
/// router. A second entry of the same transport is another router.
pub(crate) fn routers<'u>(urls: impl IntoIterator<Item = &'u RouterUrl>) -> Vec<Vec<LinkUrl>> {
    let mut routers: Vec<Vec<LinkUrl>> = Vec::new();
    // An entry with several URLs stays as it is.
    let mut open = Vec::new();
    for url in urls {
        match url {
            RouterUrl::Ways(urls) => routers.push(urls.clone()),
            RouterUrl::At(url) => {
                let is_same = |at: &&usize| {
                    let urls = &routers[**at];
                    let is_new = urls.iter().all(|other: &LinkUrl| other.scheme != url.scheme);
                    is_new
                        && urls.len() < WAYS_MAX
                        && urls.first().is_some_and(|other| other.host == url.host)
                };
                match open.iter().find(is_same) {
                    Some(at) => routers[*at].push(url.clone()),
                    None => {
                        open.push(routers.len());
                        routers.push(vec![url.clone()]);
                    }
                }
            }
            RouterUrl::Srv(_) | RouterUrl::Mdns(_) => {}
        }
    }
    routers
}

/// A URL that was skipped, and the reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SkippedUrl {
    pub(crate) url: LinkUrl,
    pub(crate) why: String,
}

/// Dials the URLs in order and returns the first success, with the URLs that were tried before it. Each attempt begins
/// when the earlier ones have failed, or when the last one has been silent for [`SILENT_AFTER`]. Once one has failed,
/// attempts that stay silent for [`SILENT_MAX`] more are abandoned and not listed.
pub(crate) async fn first<T, E, F>(
    urls: &[LinkUrl],
    mut dial: impl FnMut(LinkUrl) -> F,
) -> Result<(T, LinkUrl, Vec<SkippedUrl>), Vec<(LinkUrl, E)>>
where
    T: Send + 'static,
    E: std::fmt::Display + Send + 'static,
    F: Future<Output = Result<T, E>> + Send + 'static,
{
    let mut rest = urls.iter();
    let mut begun: Vec<&LinkUrl> = Vec::new();
    let mut racing = JoinSet::new();
    let mut failed: Vec<(LinkUrl, E)> = Vec::new();
    let mut give_up = None;
    loop {
        match rest.next() {
            Some(url) => {
                begun.push(url);
                let (attempt, url) = (dial(url.clone()), url.clone());
                racing.spawn(async move { (url, attempt.await) });
            }
            None if racing.is_empty() => return Err(failed),
            None => {}
        }
        let has_more = rest.len() > 0;
        let now = Instant::now();
        let silent = sleep_until(now + SILENT_AFTER);
        if !has_more && !failed.is_empty() {
            give_up.get_or_insert(now + SILENT_MAX);
        }
        tokio::select! {
            biased;
            Some(done) = racing.join_next() => match done {
                // The other attempts end with the set.
                Ok((url, Ok(made))) => {
                    let others = begun.into_iter().filter(|other| **other != url);
                    let passed = others.map(|other| {
                        let error = failed.iter().find(|(failed, _)| failed == other);
                        let why = error.map_or_else(|| silence(other), |(_, error)| error.to_string());
                        SkippedUrl { url: other.clone(), why }
                    });
                    let passed = passed.collect();
                    return Ok((made, url, passed));
                }
                Ok(failure) => if let (url, Err(error)) = failure {
                    failed.push((url, error));
                },
                Err(error) => tracing::error!(%error, "an attempt to connect ended abnormally"),
            },
            () = silent, if has_more => {}
            () = sleep_until(give_up.unwrap_or(now)), if give_up.is_some() => return Err(failed),
        }
    }
}

/// Returns the explanation for a silent URL.
fn silence(url: &LinkUrl) -> String {
    let silent = format!("no answer within {:.1} s", SILENT_AFTER.as_secs_f64());
    if is_over_udp(url.scheme) { format!("{silent}; is UDP blocked?") } else { silent }
}

/// Returns `true` if a transport uses UDP.
pub(crate) fn is_over_udp(scheme: Scheme) -> bool {
    matches!(scheme, Scheme::Quic | Scheme::Dtls | Scheme::Udp)
}

/// The URL that worked last for each router, kept over restarts. Clones share the state.
#[derive(Clone, Debug, Default)]
pub(crate) struct WorkingUrls {
    /// The working URL by the router's best URL.
    worked: Arc<Mutex<BTreeMap<String, String>>>,
    write: Option<watch::Sender<()>>,
}

impl WorkingUrls {
    /// Opens the memory in this state directory; without one it ends with the process. An unreadable file is reported
    /// and ignored, since everything in it can be found again.
    pub(crate) fn open(dir: Option<&Path>) -> Self {
        let Some(path) = dir.map(|dir| dir.join(FILE)) else { return Self::default() };
        let read = state::read(&path, FILE_BYTES_MAX)
            .and_then(|content| content.map(String::from_utf8).transpose().map_err(std::io::Error::other));
        let text = read.unwrap_or_else(|error| {
            warn!(path = %path.display(), %error, "cannot read the remembered URLs of routers");
            None
        });
        let lines = text.iter().flat_map(|text| text.lines());
        let worked = lines.filter_map(|line| line.split_once(' ')).take(KEPT_MAX);
        let worked: BTreeMap<_, _> = worked.map(|(best, url)| (best.to_owned(), url.to_owned())).collect();
        let (write, asked) = watch::channel(());
        let book = Self { worked: Arc::new(Mutex::new(worked)), write: Some(write) };
        tokio::spawn(keep_written(path, book.worked.clone(), asked));
        book
    }

    /// Returns the order of attempts: the URL that worked last, then the others as the user listed them.
    pub(crate) fn in_order(&self, urls: &[LinkUrl]) -> Vec<LinkUrl> {
        let last = urls.first().and_then(|best| self.worked().get(&best.to_string()).cloned());
        let (mut ordered, rest): (Vec<_>, Vec<_>) =
            urls.iter().cloned().partition(|url| last.as_ref().is_some_and(|last| *last == url.to_string()));
        ordered.extend(rest);
        ordered
    }

    /// Notes that this URL works.
    pub(crate) fn worked_by(&self, urls: &[LinkUrl], url: &LinkUrl) {
        let Some(best) = urls.first() else { return };
        let mut worked = self.worked();
        let (best, url) = (best.to_string(), url.to_string());
        // The best URL is tried first anyway, so it needs no entry.
        let is_news = if best == url {
            worked.remove(&best).is_some()
        } else if worked.len() >= KEPT_MAX && !worked.contains_key(&best) {
            false
        } else {
            worked.insert(best, url.clone()).is_none_or(|before| before != url)
        };
        drop(worked);
        if let Some(write) = self.write.as_ref().filter(|_| is_news) {
            write.send_replace(());
        }
    }

    fn worked(&self) -> MutexGuard<'_, BTreeMap<String, String>> {
        lock(&self.worked)
    }
}

/// Writes the file when the memory changes, on a blocking thread.
async fn keep_written(
    path: PathBuf,
    worked: Arc<Mutex<BTreeMap<String, String>>>,
    mut asked: watch::Receiver<()>,
) {
    while asked.changed().await.is_ok() {
        let (path, worked) = (path.clone(), worked.clone());
        let write = move || {
            let known = lock(&worked).clone();
            let text: String = known.iter().map(|(best, url)| format!("{best} {url}\n")).collect();
            match state::replace(&path, text.as_bytes()) {
                Ok(()) => debug!(path = %path.display(), "saved the URLs of routers that work"),
                Err(error) => {
                    warn!(path = %path.display(), %error, "cannot save the URLs of routers that work")
                }
            }
        };
        let _ = tokio::task::spawn_blocking(write).await;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use tokio::time::sleep;

    use super::*;

    fn url(scheme: Scheme, host: &str) -> LinkUrl {
        LinkUrl { scheme, host: host.into(), port: 7447, path: None, cost_ms: None }
    }

    fn urls(schemes: &[Scheme]) -> Vec<LinkUrl> {
        schemes.iter().map(|scheme| url(*scheme, "r")).collect()
    }

    /// Behaviour of a URL: success or failure after milliseconds. An error after a year is silence.
    type Does = (Scheme, Result<u64, u64>);

    /// Returns the winner, its time, and the explanations for the others.
    async fn race(does: &[Does]) -> Result<(Scheme, u128, Vec<String>), Vec<String>> {
        let start = Instant::now();
        let urls: Vec<_> = does.iter().map(|(scheme, _)| url(*scheme, "r")).collect();
        let does = does.to_vec();
        let made = first(&urls, |url| {
            let (_, does) = *does.iter().find(|(scheme, _)| *scheme == url.scheme).unwrap();
            async move {
                sleep(Duration::from_millis(does.unwrap_or_else(|after| after))).await;
                does.map(|_| ()).map_err(|_| "refused")
            }
        });
        let said =
            |passed: Vec<SkippedUrl>| passed.into_iter().map(|p| format!("{}: {}", p.url.scheme, p.why));
        match made.await {
            Ok(((), url, passed)) => Ok((url.scheme, start.elapsed().as_millis(), said(passed).collect())),
            Err(failed) => {
                Err(failed.into_iter().map(|(url, why)| format!("{}: {why}", url.scheme)).collect())
            }
        }
    }

    #[tokio::test(start_paused = true)]
    async fn the_next_way_is_tried_when_one_is_silent_or_fails() {
        use Scheme::{Dtls, Quic, Tls};
        const NEVER: u64 = 365 * 86_400_000;
        assert_eq!(race(&[(Quic, Ok(600)), (Tls, Ok(1))]).await, Ok((Quic, 600, vec![])));
        let blocked = "no answer within 0.7 s; is UDP blocked?";
        let both = race(&[(Quic, Err(NEVER)), (Dtls, Err(NEVER)), (Tls, Ok(100))]).await;
        assert_eq!(both, Ok((Tls, 1500, vec![format!("quic: {blocked}"), format!("dtls: {blocked}")])));
        let failed = race(&[(Quic, Err(10)), (Tls, Ok(20))]).await;
        assert_eq!(failed, Ok((Tls, 30, vec!["quic: refused".into()])));
        // A slow attempt still counts if it succeeds before the next.
        assert_eq!(race(&[(Quic, Ok(800)), (Tls, Ok(5000))]).await.unwrap().0, Quic);
        let none = race(&[(Quic, Err(2000)), (Tls, Err(10))]).await;
        assert_eq!(none, Err(vec!["tls: refused".into(), "quic: refused".into()]));
        // A silent attempt does not delay the retry of a router that is down for a moment.
        let begun = Instant::now();
        let down = race(&[(Quic, Err(NEVER)), (Tls, Err(10))]).await;
        assert_eq!((down, begun.elapsed().as_millis()), (Err(vec!["tls: refused".into()]), 3210));
    }

    #[test]
    fn entries_of_one_host_with_other_transports_are_one_router() {
        use Scheme::{Quic, Tls};
        let at = |scheme, host: &str| RouterUrl::At(url(scheme, host));
        let of = |urls: &[RouterUrl]| routers(urls);
        let one = of(&[at(Quic, "a"), at(Quic, "b"), at(Tls, "a")]);
        assert_eq!(one, [vec![url(Quic, "a"), url(Tls, "a")], vec![url(Quic, "b")]]);
        // A second entry of one transport is another router, and later entries may belong to it.
        let two = of(&[at(Quic, "a"), at(Quic, "a"), at(Tls, "a"), at(Tls, "a")]);
        assert_eq!(
            two,
            [urls(&[Quic, Tls]), urls(&[Quic, Tls])].map(|urls| {
                urls.into_iter().map(|url| LinkUrl { host: "a".into(), ..url }).collect::<Vec<_>>()
            })
        );
        let written = RouterUrl::Ways(vec![url(Quic, "a"), url(Tls, "b")]);
        assert_eq!(of(&[written, at(Tls, "a")]), [vec![url(Quic, "a"), url(Tls, "b")], vec![url(Tls, "a")]]);
    }

    #[tokio::test]
    async fn working_url_is_tried_first_after_a_restart() {
        use Scheme::{Quic, Tls, Wss};
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(FILE);
        let urls = urls(&[Quic, Tls, Wss]);
        let written = async |until: &str| {
            let arrives = async {
                while std::fs::read_to_string(&path).ok().as_deref() != Some(until) {
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
            };
            tokio::time::timeout(Duration::from_secs(30), arrives).await.expect(until);
        };
        let order =
            |book: &WorkingUrls| book.in_order(&urls).iter().map(|url| url.scheme).collect::<Vec<_>>();
        let book = WorkingUrls::open(Some(dir.path()));
        assert_eq!(order(&book), [Quic, Tls, Wss]);
        book.worked_by(&urls, &urls[1]);
        written("quic://r:7447 tls://r:7447\n").await;
        let next = WorkingUrls::open(Some(dir.path()));
        assert_eq!(order(&next), [Tls, Quic, Wss]);
        next.worked_by(&urls, &urls[0]);
        written("").await;
        assert_eq!(order(&WorkingUrls::open(Some(dir.path()))), [Quic, Tls, Wss]);
        // The file influences the order only.
        std::fs::write(&path, "quic://r:7447 tls://other:7447\nnonsense\n\u{0} \n").unwrap();
        assert_eq!(order(&WorkingUrls::open(Some(dir.path()))), [Quic, Tls, Wss]);
    }

    #[tokio::test]
    async fn the_book_is_bounded() {
        let book = WorkingUrls::default();
        for n in 0..2 * KEPT_MAX {
            let urls = [url(Scheme::Quic, &format!("r{n}")), url(Scheme::Tls, &format!("r{n}"))];
            book.worked_by(&urls, &urls[1]);
        }
        assert_eq!(book.worked().len(), KEPT_MAX);
    }
}
