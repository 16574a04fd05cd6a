//! JSON, CBOR, IDL, descriptions and payloads: none panics, and parsed values are the same after writing and reading.

use bytes::Bytes;
use sgc_cdr::{Layout, Library, TypeName, Value};

/// Runs one input of the target: a selecting byte, a text with its length (16 bits) in front, and bytes.
pub fn run(input: &[u8]) {
    let Some(input) = crate::choice_text_bytes(input) else { return };
    let (which, text, bytes) = input;
    let bytes = Bytes::copy_from_slice(bytes);
    let own: TypeName = ["p/msg/M", "p/srv/M_Request", "p/action/M_FeedbackMessage"][usize::from(which % 3)]
        .parse()
        .expect("a type");
    // The text as a definition: a `.msg` file, or IDL.
    if let Ok(layout) = Library::empty().layout(&own, &mut |_| Some(text.to_owned())) {
        check(&layout, &bytes);
        if let Ok(description) = layout.describe() {
            let described =
                Layout::from_description(&description.into(), &layout.type_hash()).expect("its own");
            assert_eq!(described.type_hash(), layout.type_hash());
        }
    }
    let _ = Library::empty().add_idl(&own, text);
    if let Some(file) = Library::shipped_files().filter(|file| file.kind() == "msg").nth(usize::from(which)) {
        check(&Library::empty().layout(&file, &mut |_| None).expect("what ships has a layout"), &bytes);
    }
    assert!(Layout::from_description(&bytes, text).is_err());
}

fn check(layout: &Layout, bytes: &Bytes) {
    let read = [
        layout.from_json(bytes).ok(),
        layout.from_cbor(bytes).ok(),
        layout.decode_as(bytes).ok().map(|(value, encoding)| {
            layout.encode_as(&value, encoding).expect("what was decoded fits");
            value
        }),
    ];
    for value in read.into_iter().flatten() {
        let payload = Bytes::from(layout.encode(&value).expect("what was read fits"));
        // A `wstring` in CDR has no NUL at its end.
        let value = layout.decode(&payload).expect("what was written");
        let payload = layout.encode(&value).expect("what was decoded fits");
        let same = |read: Value| assert_eq!(layout.encode(&read).expect("it fits").len(), payload.len());
        same(layout.from_json(value.to_json().as_bytes()).expect("our own JSON"));
        same(layout.from_cbor(&value.to_cbor().into()).expect("our own CBOR"));
    }
}
