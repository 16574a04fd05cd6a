//! Signed bodies, grants and metadata: no input panics, and decoded values encode to the same bytes.
use sgc_endpoint::{unpack_report, unpack_type};
use sgc_wire::{
    AdvertBody, AnswerBody, Decode, DescribedType, Encode, GrantContent, JoinBody, MessageHead, Metadata,
    REPORT_BYTES_MAX, Report, ReportQuestion, TYPE_DESCRIPTION_BYTES_MAX, TypeQuestion,
};

fn check<T: Decode + Encode>(input: &[u8]) {
    if let Ok(value) = T::from_slice(input) {
        assert_eq!(value.to_vec(), input);
    }
}

/// Runs one input of the target.
pub fn run(input: &[u8]) {
    let Some((which, input)) = input.split_first() else { return };
    match which % 10 {
        0 => check::<AdvertBody>(input),
        1 => check::<JoinBody>(input),
        2 => check::<AnswerBody>(input),
        3 => check::<GrantContent>(input),
        4 => check::<Metadata>(input),
        5 => check::<MessageHead>(input),
        6 => check::<TypeQuestion>(input),
        7 => {
            check::<DescribedType>(input);
            if let Ok(description) = DescribedType::from_slice(input).map(|told| unpack_type(&told)) {
                assert!(description.map_or(true, |bytes| bytes.len() <= TYPE_DESCRIPTION_BYTES_MAX));
            }
        }
        8 => check::<ReportQuestion>(input),
        _ => {
            check::<Report>(input);
            if let Ok(document) = Report::from_slice(input).map(|report| unpack_report(&report)) {
                assert!(document.map_or(true, |bytes| bytes.len() <= REPORT_BYTES_MAX));
            }
        }
    }
}
