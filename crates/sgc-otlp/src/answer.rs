//! [`Answer`]: a collector's answer, and its meaning.
//!
//! Everything in an answer is hostile. Texts are cut and lose control characters, since they go to logs and terminals.

use std::time::{Duration, SystemTime};

use prost::Message as _;

use crate::fault::Fault;
use crate::messages::proto::collector::metrics::v1::ExportMetricsServiceResponse;
use crate::messages::status::Status;
use crate::request::CONTENT_TYPE;

/// Most bytes that are read of an answer's body.
pub const BODY_BYTES_MAX: usize = 64 << 10;
/// Most characters that are taken of a text of the collector.
const TEXT_CHARS_MAX: usize = 200;

/// An answer over HTTP.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Answer {
    /// The status code.
    pub status: u16,
    /// `Content-Type`.
    pub content_type: Option<String>,
    /// `Retry-After`.
    pub retry_after: Option<String>,
    /// `Location`.
    pub location: Option<String>,
    /// The body, or its first [`BODY_BYTES_MAX`] bytes.
    pub body: Vec<u8>,
    /// Whether the body is longer than that.
    pub is_cut: bool,
}

impl Answer {
    /// Judges an answer that came at `now`. Returns the collector's warning if it took everything; empty for none.
    pub fn judge(&self, now: SystemTime) -> Result<String, Fault> {
        let status = self.status;
        match status {
            200..=299 => self.accepted(),
            300..=399 => Err(Fault::Redirected {
                status,
                location: shown(self.location.as_deref().unwrap_or_default()),
            }),
            // The retryable codes of the specification.
            429 | 502 | 503 | 504 => {
                let retry_after = self.retry_after.as_deref().and_then(|text| wait(text, now));
                Err(Fault::Busy { status, message: self.message(), retry_after })
            }
            _ => Err(Fault::Refused { status, message: self.message() }),
        }
    }

    fn accepted(&self) -> Result<String, Fault> {
        if self.is_cut {
            return Err(Fault::NotOtlp { reason: format!("it is longer than {BODY_BYTES_MAX} bytes") });
        }
        match self.media_type().as_deref() {
            // Some collectors answer without a body, and some in JSON whatever they were asked in.
            _ if self.body.is_empty() => return Ok(String::new()),
            Some("application/json") => return Ok(String::new()),
            Some(CONTENT_TYPE | "application/protobuf") | None => {}
            Some(other) => return Err(Fault::NotOtlp { reason: format!("its type is {}", shown(other)) }),
        }
        let response = ExportMetricsServiceResponse::decode(&self.body[..])
            .map_err(|error| Fault::NotOtlp { reason: shown(&error.to_string()) })?;
        let partial = response.partial_success.unwrap_or_default();
        let message = shown(&partial.error_message);
        match u64::try_from(partial.rejected_data_points) {
            Ok(0) | Err(_) => Ok(message),
            Ok(rejected) => Err(Fault::Partial { rejected, message }),
        }
    }

    fn media_type(&self) -> Option<String> {
        let content_type = self.content_type.as_deref()?;
        Some(content_type.split(';').next().unwrap_or_default().trim().to_ascii_lowercase())
    }

    /// Returns the explanation in the body of a refusal.
    fn message(&self) -> String {
        match self.media_type().as_deref() {
            Some(CONTENT_TYPE | "application/protobuf") => {
                Status::decode(&self.body[..]).map(|status| shown(&status.message)).unwrap_or_default()
            }
            // A page for browsers explains nothing in its first characters.
            Some("text/html") => String::new(),
            _ => shown(&String::from_utf8_lossy(&self.body)),
        }
    }
}

/// Returns a text of the collector without control characters, in one line, cut.
fn shown(text: &str) -> String {
    let words = text.split(|c: char| c.is_whitespace() || c.is_control()).filter(|word| !word.is_empty());
    let mut line = String::new();
    for word in words {
        if !line.is_empty() {
            line.push(' ');
        }
        line.push_str(word);
        // Characters have at most four bytes, so there are enough.
        if line.len() > 4 * TEXT_CHARS_MAX {
            break;
        }
    }
    match line.char_indices().nth(TEXT_CHARS_MAX) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line,
    }
}

/// Returns the wait of `Retry-After`, which is a number of seconds or a date (RFC 9110, section 10.2.3).
fn wait(text: &str, now: SystemTime) -> Option<Duration> {
    let text = text.trim();
    if !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit()) {
        return Some(Duration::from_secs(text.parse().unwrap_or(u64::MAX)));
    }
    let until = httpdate::parse_http_date(text).ok()?;
    Some(until.duration_since(now).unwrap_or(Duration::ZERO))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::time::UNIX_EPOCH;

    use super::*;
    use crate::messages::proto::collector::metrics::v1::ExportMetricsPartialSuccess;

    const NOW: SystemTime = UNIX_EPOCH;

    fn answer(status: u16, content_type: &str, body: impl Into<Vec<u8>>) -> Answer {
        let content_type = Some(content_type.to_owned()).filter(|text| !text.is_empty());
        Answer { status, content_type, body: body.into(), ..Answer::default() }
    }

    fn partial(rejected_data_points: i64, error_message: &str) -> Vec<u8> {
        let partial_success = Some(ExportMetricsPartialSuccess {
            rejected_data_points,
            error_message: error_message.to_owned(),
        });
        ExportMetricsServiceResponse { partial_success }.encode_to_vec()
    }

    #[test]
    fn accepted_values_and_warnings_are_told_from_lost_values() {
        assert_eq!(answer(200, CONTENT_TYPE, "").judge(NOW), Ok(String::new()));
        assert_eq!(answer(204, "", "").judge(NOW), Ok(String::new()));
        assert_eq!(answer(200, "application/json; charset=utf-8", "{}").judge(NOW), Ok(String::new()));
        assert_eq!(
            answer(200, CONTENT_TYPE, partial(0, "old\nversion")).judge(NOW),
            Ok("old version".into())
        );
        let lost = answer(200, CONTENT_TYPE, partial(3, "out of order")).judge(NOW);
        assert_eq!(lost, Err(Fault::Partial { rejected: 3, message: "out of order".into() }));
        assert_eq!(answer(200, CONTENT_TYPE, partial(-3, "")).judge(NOW), Ok(String::new()));
    }

    #[test]
    fn answer_of_another_server_is_no_success() {
        for (content_type, body) in [("text/html", "<html>"), (CONTENT_TYPE, "not protobuf"), ("", "hello")] {
            let judged = answer(200, content_type, body).judge(NOW);
            assert!(matches!(judged, Err(Fault::NotOtlp { .. })), "{content_type} {body}: {judged:?}");
        }
        let endless = Answer { is_cut: true, ..answer(200, CONTENT_TYPE, vec![0; BODY_BYTES_MAX]) };
        assert!(matches!(endless.judge(NOW), Err(Fault::NotOtlp { .. })));
    }

    #[test]
    fn only_codes_of_the_specification_are_busy() {
        for status in 300..=599 {
            let fault = answer(status, "", "").judge(NOW).unwrap_err();
            let expected = matches!(status, 429 | 502 | 503 | 504);
            assert_eq!(matches!(fault, Fault::Busy { .. }), expected, "{status}");
            assert_eq!(fault.is_passing(), expected, "{status}");
            assert_eq!(matches!(fault, Fault::Redirected { .. }), status < 400, "{status}");
        }
        // 1xx are no final answers.
        assert!(matches!(answer(100, "", "").judge(NOW), Err(Fault::Refused { .. })));
    }

    #[test]
    fn wait_is_in_seconds_or_until_a_date() {
        let asked = |text: &str| {
            let busy = Answer { retry_after: Some(text.to_owned()), ..answer(503, "", "") };
            match busy.judge(UNIX_EPOCH + Duration::from_secs(784_111_777)) {
                Err(Fault::Busy { retry_after, .. }) => retry_after.map(|wait| wait.as_secs()),
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(asked(" 120 "), Some(120));
        assert_eq!(asked("Sun, 06 Nov 1994 08:50:00 GMT"), Some(23));
        assert_eq!(asked("Sun, 06 Nov 1994 08:40:00 GMT"), Some(0), "it is over");
        assert_eq!(asked("99999999999999999999999"), Some(u64::MAX));
        for text in ["", "-1", "soon", "1.5", "+3"] {
            assert_eq!(asked(text), None, "{text}");
        }
    }

    #[test]
    fn explanation_is_one_short_line_without_control_characters() {
        let status = Status { code: 3, message: "no \u{1b}[31mtoken\r\nfound".to_owned() };
        let said = |answer: Answer| match answer.judge(NOW) {
            Err(Fault::Refused { message, .. }) => message,
            other => panic!("{other:?}"),
        };
        assert_eq!(said(answer(401, CONTENT_TYPE, status.encode_to_vec())), "no [31mtoken found");
        assert_eq!(said(answer(401, CONTENT_TYPE, "broken")), "");
        assert_eq!(said(answer(404, "text/html", "<html>")), "");
        assert_eq!(said(answer(404, "text/plain", "404 page not found\n")), "404 page not found");
        let long = said(answer(400, "", vec![b'x'; BODY_BYTES_MAX]));
        assert_eq!(long.chars().count(), TEXT_CHARS_MAX + 1);
        assert_eq!(said(answer(400, "", [0xff, 0x00, b'a'])), "\u{fffd} a");
        let redirect = Answer { location: Some("https://evil.example/\n".into()), ..answer(302, "", "") };
        let fault = redirect.judge(NOW).unwrap_err();
        assert_eq!(
            fault.to_string(),
            "it redirects (status 302) to https://evil.example/, which is not followed"
        );
    }
}
