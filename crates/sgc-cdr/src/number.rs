//! Numbers on their way to a type, which they have to fit.

use crate::definition::Primitive;
use crate::fault::ValueProblem;
use crate::value::Value;

/// Integers up to this one have a `float64` of their own.
const WHOLE_MAX: f64 = 9_007_199_254_740_992.0;

/// A number before its conversion.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Number {
    Integer(i128),
    Float32(f32),
    Float64(f64),
}

impl Number {
    pub(crate) fn from_value(value: &Value) -> Option<Self> {
        Some(match value {
            Value::Int(value) => Self::Integer(i128::from(*value)),
            Value::Uint(value) => Self::Integer(i128::from(*value)),
            Value::Float32(value) => Self::Float32(*value),
            Value::Float64(value) => Self::Float64(*value),
            _ => return None,
        })
    }

    /// Converts the number to a type. Integers become the nearest float; floats become integers if they are whole and
    /// exact.
    pub(crate) fn fit(self, primitive: Primitive) -> Result<Value, ValueProblem> {
        match primitive {
            Primitive::Bool => Err(self.is_no(primitive)),
            Primitive::Float64 => Ok(Value::Float64(self.float())),
            Primitive::Float32 => match self {
                Self::Float32(value) => Ok(Value::Float32(value)),
                Self::Integer(value) => Ok(Value::Float32(value as f32)),
                Self::Float64(value) => {
                    let narrow = value as f32;
                    // An infinity stays infinite; a finite number does not become infinite.
                    if narrow.is_infinite() && value.is_finite() {
                        return Err(self.out_of(primitive));
                    }
                    Ok(Value::Float32(narrow))
                }
            },
            Primitive::Int8 => self.signed(primitive, i8::MIN.into(), i8::MAX.into()),
            Primitive::Int16 => self.signed(primitive, i16::MIN.into(), i16::MAX.into()),
            Primitive::Int32 => self.signed(primitive, i32::MIN.into(), i32::MAX.into()),
            Primitive::Int64 => self.signed(primitive, i64::MIN.into(), i64::MAX.into()),
            Primitive::Byte | Primitive::Uint8 => self.unsigned(primitive, u8::MAX.into()),
            Primitive::Uint16 => self.unsigned(primitive, u16::MAX.into()),
            Primitive::Uint32 => self.unsigned(primitive, u32::MAX.into()),
            Primitive::Uint64 => self.unsigned(primitive, u64::MAX.into()),
        }
    }

    fn signed(self, primitive: Primitive, low: i128, high: i128) -> Result<Value, ValueProblem> {
        let value = self.whole(primitive)?;
        let within = (low..=high).contains(&value);
        i64::try_from(value).ok().filter(|_| within).map(Value::Int).ok_or_else(|| self.out_of(primitive))
    }

    fn unsigned(self, primitive: Primitive, high: i128) -> Result<Value, ValueProblem> {
        let value = self.whole(primitive)?;
        let within = value <= high;
        u64::try_from(value).ok().filter(|_| within).map(Value::Uint).ok_or_else(|| self.out_of(primitive))
    }

    fn whole(self, primitive: Primitive) -> Result<i128, ValueProblem> {
        match self {
            Self::Integer(value) => Ok(value),
            Self::Float32(_) | Self::Float64(_) => match self.float() {
                value if value.fract() != 0.0 => Err(self.is_no(primitive)),
                value if value.abs() > WHOLE_MAX => Err(self.out_of(primitive)),
                value => Ok(value as i128),
            },
        }
    }

    fn float(self) -> f64 {
        match self {
            Self::Integer(value) => value as f64,
            Self::Float32(value) => f64::from(value),
            Self::Float64(value) => value,
        }
    }

    fn shown(self) -> String {
        match self {
            Self::Integer(value) => value.to_string(),
            Self::Float32(value) => value.to_string(),
            Self::Float64(value) => value.to_string(),
        }
    }

    fn is_no(self, primitive: Primitive) -> ValueProblem {
        ValueProblem::Kind { found: self.shown(), expected: primitive.name() }
    }

    fn out_of(self, primitive: Primitive) -> ValueProblem {
        ValueProblem::Range { found: self.shown(), expected: primitive.name() }
    }
}

/// Converts a value to a primitive, if it fits.
pub(crate) fn fit(value: &Value, primitive: Primitive) -> Result<Value, ValueProblem> {
    match (primitive, value) {
        (Primitive::Bool, Value::Bool(value)) => Ok(Value::Bool(*value)),
        _ => match Number::from_value(value) {
            Some(number) => number.fit(primitive),
            None => Err(ValueProblem::Kind { found: value.kind().to_owned(), expected: primitive.name() }),
        },
    }
}

/// Returns the bytes of a value that fits its primitive, little endian: the first of eight.
pub(crate) fn little(value: &Value) -> [u8; 8] {
    match value {
        Value::Bool(value) => u64::from(*value).to_le_bytes(),
        Value::Int(value) => value.to_le_bytes(),
        Value::Uint(value) => value.to_le_bytes(),
        Value::Float32(value) => u64::from(value.to_bits()).to_le_bytes(),
        Value::Float64(value) => value.to_le_bytes(),
        _ => [0; 8],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_fit_or_say_why_not() {
        let integer = |value, primitive| Number::Integer(value).fit(primitive);
        let float = |value, primitive| Number::Float64(value).fit(primitive);
        assert_eq!(integer(-128, Primitive::Int8), Ok(Value::Int(-128)));
        assert_eq!(
            integer(1 << 64, Primitive::Uint64).unwrap_err().to_string(),
            "18446744073709551616 is not within the range of uint64"
        );
        assert!(matches!(integer(-1, Primitive::Byte), Err(ValueProblem::Range { .. })));
        assert_eq!(float(3.0, Primitive::Int16), Ok(Value::Int(3)));
        assert_eq!(float(3.5, Primitive::Int16).unwrap_err().to_string(), "3.5, not int16");
        // The next whole float stands for more than one integer.
        assert!(matches!(
            float(-9_223_372_036_854_775_808.0, Primitive::Int64),
            Err(ValueProblem::Range { .. })
        ));
        assert!(float(f64::NAN, Primitive::Int32).is_err());
        assert_eq!(float(f64::INFINITY, Primitive::Float32), Ok(Value::Float32(f32::INFINITY)));
        assert!(matches!(float(1e300, Primitive::Float32), Err(ValueProblem::Range { .. })));
        assert_eq!(integer(1, Primitive::Float64), Ok(Value::Float64(1.0)));
        assert!(integer(1, Primitive::Bool).is_err());
    }
}
