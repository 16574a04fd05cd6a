//! Values as YAML, as `ros2 topic echo` shows them.

use std::fmt::Write as _;

use crate::value::Value;

/// Extent of the shown message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct YamlStyle {
    /// Elements of a sequence, and characters of a text, that are shown; `None` for all.
    pub elements: Option<usize>,
}

impl Default for YamlStyle {
    /// Returns the style of `ros2 topic echo` without `--full-length`.
    fn default() -> Self {
        Self { elements: Some(128) }
    }
}

impl Value {
    /// Returns YAML, each line ended.
    pub fn to_yaml(&self, style: YamlStyle) -> String {
        let mut out = String::new();
        match self {
            Self::Record(members) if !members.is_empty() => block(&mut out, self, 0, style, false),
            Self::List(_) | Self::Octets(_) | Self::PackedArray(_) => {
                block(&mut out, self, 0, style, false);
                if !out.ends_with('\n') {
                    out.push('\n');
                }
            }
            other => {
                out.push_str(&scalar(other, style));
                out.push('\n');
            }
        }
        out
    }
}

/// Writes a value with lines of its own. `begun` if its first line has begun.
fn block(out: &mut String, value: &Value, depth: usize, style: YamlStyle, begun: bool) {
    let indent = |out: &mut String, begun: bool| {
        if !begun {
            out.extend(std::iter::repeat_n("  ", depth));
        }
    };
    match value {
        Value::Record(members) => {
            for (index, (name, member)) in members.iter().enumerate() {
                indent(out, begun && index == 0);
                let _ = write!(out, "{name}:");
                match member {
                    Value::Record(inner) if !inner.is_empty() => {
                        out.push('\n');
                        block(out, member, depth + 1, style, false);
                    }
                    Value::List(_) | Value::Octets(_) | Value::PackedArray(_) if !is_empty(member) => {
                        out.push('\n');
                        block(out, member, depth, style, false);
                    }
                    other => {
                        let _ = writeln!(out, " {}", scalar(other, style));
                    }
                }
            }
        }
        Value::List(all) => {
            let shown = style.elements.unwrap_or(all.len()).min(all.len());
            for (index, element) in all.iter().take(shown).enumerate() {
                indent(out, begun && index == 0);
                out.push_str("- ");
                match element {
                    Value::Record(members) if !members.is_empty() => {
                        block(out, element, depth + 1, style, true)
                    }
                    other => {
                        let _ = writeln!(out, "{}", scalar(other, style));
                    }
                }
            }
            ellipsis(out, shown < all.len(), indent);
        }
        Value::Octets(octets) => {
            let shown = style.elements.unwrap_or(octets.len()).min(octets.len());
            for octet in octets.iter().take(shown) {
                indent(out, false);
                let _ = writeln!(out, "- {octet}");
            }
            ellipsis(out, shown < octets.len(), indent);
        }
        Value::PackedArray(packed) => {
            let shown = style.elements.unwrap_or(packed.len()).min(packed.len());
            for element in packed.iter().take(shown) {
                indent(out, false);
                let _ = writeln!(out, "- {}", scalar(&element, style));
            }
            ellipsis(out, shown < packed.len(), indent);
        }
        other => out.push_str(&scalar(other, style)),
    }
    if is_empty(value) {
        out.push_str("[]");
    }
}

fn ellipsis(out: &mut String, cut: bool, indent: impl Fn(&mut String, bool)) {
    if cut {
        indent(out, false);
        out.push_str("- '...'\n");
    }
}

fn is_empty(value: &Value) -> bool {
    match value {
        Value::List(all) => all.is_empty(),
        Value::Octets(octets) => octets.is_empty(),
        Value::PackedArray(packed) => packed.is_empty(),
        _ => false,
    }
}

fn scalar(value: &Value, style: YamlStyle) -> String {
    match value {
        Value::Bool(value) => value.to_string(),
        Value::Int(value) => value.to_string(),
        Value::Uint(value) => value.to_string(),
        Value::Float32(value) => float(f64::from(*value)),
        Value::Float64(value) => float(*value),
        Value::Text(text) => shown(text, style),
        // YAML has no form for invalid Unicode.
        Value::Raw(bytes) => shown(&String::from_utf8_lossy(bytes), style),
        Value::Wide(units) => shown(&String::from_utf16_lossy(units), style),
        Value::List(_) | Value::Octets(_) | Value::PackedArray(_) => "[]".to_owned(),
        Value::Record(_) => "{}".to_owned(),
    }
}

fn shown(text: &str, style: YamlStyle) -> String {
    match style.elements {
        Some(most) if text.chars().count() > most => {
            quoted(&format!("{}...", text.chars().take(most).collect::<String>()))
        }
        _ => quoted(text),
    }
}

/// Returns a float as Python shows it in YAML: `1.0`, `1.0e-05`, `.nan`.
fn float(value: f64) -> String {
    if value.is_nan() {
        return ".nan".to_owned();
    }
    if value.is_infinite() {
        return if value > 0.0 { ".inf".to_owned() } else { "-.inf".to_owned() };
    }
    let size = value.abs();
    if size != 0.0 && !(1e-4..1e16).contains(&size) {
        let text = format!("{value:e}");
        let (digits, exponent) = text.split_once('e').unwrap_or((&text, "0"));
        let digits = if digits.contains('.') { digits.to_owned() } else { format!("{digits}.0") };
        let (sign, exponent) = match exponent.strip_prefix('-') {
            Some(exponent) => ('-', exponent),
            None => ('+', exponent),
        };
        return format!("{digits}e{sign}{exponent:0>2}");
    }
    let text = value.to_string();
    if text.contains('.') { text } else { format!("{text}.0") }
}

/// Returns a text, in quotes where YAML would take it for something else.
fn quoted(text: &str) -> String {
    let control = |c: char| {
        c.is_control() || matches!(c, '\u{2028}' | '\u{2029}' | '\u{feff}' | '\u{fffe}' | '\u{ffff}')
    };
    if text.chars().any(control) {
        let mut out = String::from("\"");
        for c in text.chars() {
            match c {
                '"' => out.push_str("\\\""),
                '\\' => out.push_str("\\\\"),
                '\n' => out.push_str("\\n"),
                '\t' => out.push_str("\\t"),
                '\r' => out.push_str("\\r"),
                '\0' => out.push_str("\\0"),
                c if control(c) => {
                    let _ = match u32::from(c) {
                        code @ ..0x100 => write!(out, "\\x{code:02X}"),
                        code => write!(out, "\\u{code:04X}"),
                    };
                }
                c => out.push(c),
            }
        }
        out.push('"');
        return out;
    }
    if is_plain(text) { text.to_owned() } else { format!("'{}'", text.replace('\'', "''")) }
}

fn is_plain(text: &str) -> bool {
    const WORDS: [&str; 13] =
        ["~", "null", "true", "false", "yes", "no", "on", "off", "y", "n", ".nan", ".inf", "<<"];
    let (Some(first), Some(last)) = (text.chars().next(), text.chars().next_back()) else { return false };
    let indicator = "!&*%#`@|>'\"{}[],?:-".contains(first)
        && !(matches!(first, '-' | '?' | ':') && text.chars().nth(1).is_some_and(|c| c != ' '))
        || text.starts_with("---");
    let number = {
        let unsigned = text.trim_start_matches(['+', '-']);
        unsigned.starts_with(|c: char| c.is_ascii_digit() || c == '.')
            && unsigned.chars().all(|c| c.is_ascii_hexdigit() || "._:xoeEb+-".contains(c))
            || unsigned.eq_ignore_ascii_case(".inf")
    };
    !(indicator
        || number
        || first == ' '
        || last == ' '
        || last == ':'
        || first == '='
        || text.contains(": ")
        || text.contains(" #")
        || WORDS.iter().any(|word| word.eq_ignore_ascii_case(text)))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use bytes::Bytes;

    use super::*;

    #[test]
    fn floats_as_python_shows_them() {
        for (value, text) in [
            (1.0, "1.0"),
            (-0.0, "-0.0"),
            (1e-5, "1.0e-05"),
            (1.5e300, "1.5e+300"),
            (1e15, "1000000000000000.0"),
            (1e16, "1.0e+16"),
            (f64::from(0.1_f32), "0.10000000149011612"),
            (f64::NAN, ".nan"),
            (f64::NEG_INFINITY, "-.inf"),
        ] {
            assert_eq!(float(value), text);
        }
    }

    #[test]
    fn texts_keep_their_meaning() {
        for (text, shown) in [
            ("base_link", "base_link"),
            ("", "''"),
            ("hello world: 1", "'hello world: 1'"),
            ("1", "'1'"),
            ("-1.5e3", "'-1.5e3'"),
            ("12:30", "'12:30'"),
            ("TRUE", "'TRUE'"),
            ("- x", "'- x'"),
            ("-x", "-x"),
            ("it's", "it's"),
            ("'q'", "'''q'''"),
            ("a\nb", "\"a\\nb\""),
            ("a\u{1b}b", "\"a\\x1Bb\""),
            ("x:", "'x:'"),
            ("grün", "grün"),
        ] {
            assert_eq!(quoted(text), shown);
        }
    }

    #[test]
    fn structure_is_shown_by_indentation() {
        let record = |members: Vec<(&str, Value)>| {
            Value::Record(members.into_iter().map(|(name, value)| (Arc::from(name), value)).collect())
        };
        let point = record(vec![("x", Value::Float64(1.0)), ("name", Value::Text("p".into()))]);
        let message = record(vec![
            ("header", record(vec![("frame_id", Value::Text(String::new()))])),
            ("points", Value::List(vec![point.clone(), point])),
            ("none", Value::List(Vec::new())),
            ("data", Value::Octets(Bytes::from_static(&[1, 2, 3]))),
        ]);
        let expected = "header:\n  frame_id: ''\npoints:\n- x: 1.0\n  name: p\n- x: 1.0\n  name: p\nnone: []\ndata:\n\
                        - 1\n- 2\n- '...'\n";
        assert_eq!(message.to_yaml(YamlStyle { elements: Some(2) }), expected);
        assert_eq!(Value::List(Vec::new()).to_yaml(YamlStyle::default()), "[]\n");
    }
}
