//! Decodes `TYPE HEX` lines of its input to JSON, for `scripts/cdr-vectors.py`; `hash TYPE` lines to the type's hash.
#![allow(clippy::print_stdout)]

use std::io::BufRead as _;

use sgc_cdr::Library;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut library = Library::empty();
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let (first, second) = line.split_once(' ').ok_or("not two words")?;
        if first == "hash" {
            println!("{}", library.layout(&second.parse()?, &mut |_| None)?.type_hash());
            continue;
        }
        let layout = library.layout(&first.parse()?, &mut |_| None)?;
        let digits = second.as_bytes().chunks_exact(2).map(std::str::from_utf8);
        let payload: Vec<u8> = digits
            .map(|two| Ok(u8::from_str_radix(two?, 16)?))
            .collect::<Result<_, Box<dyn std::error::Error>>>()?;
        match layout.decode(&payload.into()) {
            Ok(value) => println!("{}", value.to_json()),
            Err(error) => println!("{first}: {error}"),
        }
    }
    Ok(())
}
