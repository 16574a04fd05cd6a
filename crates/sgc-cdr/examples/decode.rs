//! For `scripts/cdr-vectors.py`, a line of output for each of input:
//!
//! - `hash TYPE`: the type's hash, that of what its description describes;
//! - `json TYPE JSON`: the message in CDR, in hexadecimal digits;
//! - `TYPE HEX`: the message in JSON, in CDR again by way of that JSON, and by way of CBOR.
#![allow(clippy::print_stdout)]

use std::fmt::Write as _;
use std::io::BufRead as _;

use sgc_cdr::{Layout, Library};

type Error = Box<dyn std::error::Error>;

fn main() -> Result<(), Error> {
    let mut library = Library::empty();
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let (first, rest) = line.split_once(' ').ok_or("not two words")?;
        let mut layout =
            |name: &str| -> Result<Layout, Error> { Ok(library.layout(&name.parse()?, &mut |_| None)?) };
        let done = match (first, rest.split_once(' ')) {
            ("hash", _) => hash(&layout(rest)?),
            ("json", Some((name, json))) => write(&layout(name)?, json),
            _ => read(&layout(first)?, rest),
        };
        match done {
            Ok(text) => println!("{text}"),
            Err(error) => println!("{first}: {error}"),
        }
    }
    Ok(())
}

fn hash(layout: &Layout) -> Result<String, Error> {
    let described = Layout::from_description(&layout.describe()?.into(), &layout.type_hash())?;
    Ok(described.type_hash())
}

fn write(layout: &Layout, json: &str) -> Result<String, Error> {
    Ok(hex(&layout.encode(&layout.from_json(json.as_bytes())?)?))
}

fn read(layout: &Layout, digits: &str) -> Result<String, Error> {
    let digits = digits.as_bytes().chunks_exact(2).map(std::str::from_utf8);
    let payload: Vec<u8> =
        digits.map(|two| Ok(u8::from_str_radix(two?, 16)?)).collect::<Result<_, Error>>()?;
    let (value, encoding) = layout.decode_as(&payload.into())?;
    let json = value.to_json();
    let by_json = layout.encode_as(&layout.from_json(json.as_bytes())?, encoding)?;
    let by_cbor = layout.encode_as(&layout.from_cbor(&value.to_cbor().into())?, encoding)?;
    Ok(format!("{json} {} {}", hex(&by_json), hex(&by_cbor)))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}
