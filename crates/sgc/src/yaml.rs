//! Parses messages as users type them, JSON or the YAML of `ros2 topic pub`, to JSON (`docs/spec/json.md`).

use std::fmt;

use serde::de::{Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};

/// Deepest nesting of values.
const DEPTH_MAX: usize = 64;

/// Converts a message in JSON or YAML to JSON. An empty text is a message whose members all have their defaults.
pub(crate) fn json_of(text: &str) -> Result<String, String> {
    if text.trim().is_empty() {
        return Ok("{}".to_owned());
    }
    // Valid JSON stays as it is, so that numbers keep all digits.
    if serde_json::from_str::<serde::de::IgnoredAny>(text).is_ok() {
        return Ok(text.split('\n').collect());
    }
    let mut options = serde_saphyr::Options::default();
    options.non_finite_float_policy = serde_saphyr::options::NonFiniteFloatPolicy::PassThrough;
    let node: Node = serde_saphyr::from_str_with_options(text, options).map_err(|error| error.to_string())?;
    let mut json = String::new();
    node.write(&mut json, 0)?;
    Ok(json)
}

/// A YAML value.
enum Node {
    Null,
    Plain(String),
    Text(String),
    List(Vec<Node>),
    Map(Vec<(String, Node)>),
}

impl Node {
    fn write(&self, json: &mut String, depth: usize) -> Result<(), String> {
        if depth > DEPTH_MAX {
            return Err(format!("values are nested deeper than {DEPTH_MAX}"));
        }
        let quote = |text: &str| serde_json::to_string(text).map_err(|error| error.to_string());
        match self {
            Self::Null => json.push_str("null"),
            Self::Plain(text) => json.push_str(text),
            Self::Text(text) => json.push_str(&quote(text)?),
            Self::List(all) => {
                json.push('[');
                for (at, node) in all.iter().enumerate() {
                    if at > 0 {
                        json.push(',');
                    }
                    node.write(json, depth + 1)?;
                }
                json.push(']');
            }
            Self::Map(all) => {
                json.push('{');
                for (at, (key, node)) in all.iter().enumerate() {
                    if at > 0 {
                        json.push(',');
                    }
                    json.push_str(&quote(key)?);
                    json.push(':');
                    node.write(json, depth + 1)?;
                }
                json.push('}');
            }
        }
        Ok(())
    }
}

impl<'de> Deserialize<'de> for Node {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Any;
        impl<'de> Visitor<'de> for Any {
            type Value = Node;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a value of a message")
            }

            fn visit_bool<E>(self, value: bool) -> Result<Node, E> {
                Ok(Node::Plain(value.to_string()))
            }

            fn visit_i64<E>(self, value: i64) -> Result<Node, E> {
                Ok(Node::Plain(value.to_string()))
            }

            fn visit_u64<E>(self, value: u64) -> Result<Node, E> {
                Ok(Node::Plain(value.to_string()))
            }

            fn visit_f64<E>(self, value: f64) -> Result<Node, E> {
                Ok(match value {
                    _ if value.is_nan() => Node::Text("NaN".into()),
                    f64::INFINITY => Node::Text("Infinity".into()),
                    f64::NEG_INFINITY => Node::Text("-Infinity".into()),
                    _ => Node::Plain(format!("{value:?}")),
                })
            }

            fn visit_str<E>(self, value: &str) -> Result<Node, E> {
                Ok(Node::Text(value.to_owned()))
            }

            fn visit_unit<E>(self) -> Result<Node, E> {
                Ok(Node::Null)
            }

            fn visit_none<E>(self) -> Result<Node, E> {
                Ok(Node::Null)
            }

            fn visit_some<D: Deserializer<'de>>(self, deserializer: D) -> Result<Node, D::Error> {
                Node::deserialize(deserializer)
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut access: A) -> Result<Node, A::Error> {
                let mut all = Vec::new();
                while let Some(node) = access.next_element()? {
                    all.push(node);
                }
                Ok(Node::List(all))
            }

            fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<Node, A::Error> {
                let mut all = Vec::new();
                while let Some((key, node)) = access.next_entry()? {
                    all.push((key, node));
                }
                Ok(Node::Map(all))
            }
        }
        deserializer.deserialize_any(Any)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_stays_unchanged_and_yaml_becomes_json() {
        let same = r#"{"a": 9007199254740993, "b": [1.50]}"#;
        assert_eq!(json_of(same).unwrap(), same);
        assert_eq!(json_of("  ").unwrap(), "{}");
        assert_eq!(json_of("{\n\"a\": 1\n}").unwrap(), "{\"a\": 1}");
        let yaml = [
            ("{linear: {x: 0.5}, angular: {z: -1}}", r#"{"linear":{"x":0.5},"angular":{"z":-1}}"#),
            ("data: hello world", r#"{"data":"hello world"}"#),
            ("data: 'true'\nflag: true", r#"{"data":"true","flag":true}"#),
            ("values: [.nan, .inf, -.inf, 1e3]", r#"{"values":["NaN","Infinity","-Infinity",1000.0]}"#),
            ("points:\n- {x: 1}\n- {x: 2}\n", r#"{"points":[{"x":1},{"x":2}]}"#),
            ("big: 18446744073709551615", r#"{"big":18446744073709551615}"#),
        ];
        for (text, json) in yaml {
            assert_eq!(json_of(text).unwrap(), json, "{text}");
        }
        assert!(json_of("{a: [").is_err());
    }
}
