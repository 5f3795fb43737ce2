//! Payloads as JSON: for `vantage tap`, and for viewers that plot a recording without knowing our layouts.

use serde_json::{Map, Value, json};

use crate::ServiceName;
use crate::bus::Envelope;
use crate::channel::Channel;

/// What can be told in JSON. Implemented by [`payload!`](crate::payload!) for structs, here for numbers and arrays of them.
pub trait Describe: Sized {
    /// The value. A number that is not finite is null; an array of bytes is text.
    fn json(&self) -> Value;

    /// The JSON schema of such values.
    fn schema() -> Value;

    /// An array of them.
    #[must_use]
    fn json_of(items: &[Self]) -> Value {
        items.iter().map(Self::json).collect()
    }

    /// The schema of an array.
    #[must_use]
    fn schema_of() -> Value {
        json!({ "type": "array", "items": Self::schema() })
    }
}

macro_rules! numbers {
    ($schema:tt: $($number:ty),*) => { $(
        impl Describe for $number {
            fn json(&self) -> Value {
                Value::from(*self)
            }

            fn schema() -> Value {
                json!({ "type": $schema })
            }
        }
    )* };
}
numbers!("integer": u16, u32, u64, i32, i64);
numbers!(["number", "null"]: f32, f64);

impl Describe for u8 {
    fn json(&self) -> Value {
        Value::from(*self)
    }

    fn schema() -> Value {
        json!({ "type": "integer" })
    }

    fn json_of(items: &[Self]) -> Value {
        Value::from(crate::payload::unpack_text(items))
    }

    fn schema_of() -> Value {
        json!({ "type": "string" })
    }
}

impl<T: Describe, const N: usize> Describe for [T; N] {
    fn json(&self) -> Value {
        T::json_of(self)
    }

    fn schema() -> Value {
        T::schema_of()
    }
}

/// For [`payload!`](crate::payload!): a field among others; what is reserved is nothing to tell.
#[doc(hidden)]
pub fn tell<T: Describe>(fields: &mut Map<String, Value>, name: &str, value: &T) {
    if name != "reserved" {
        fields.insert(name.to_owned(), value.json());
    }
}

/// As [`tell`], of the schema.
#[doc(hidden)]
pub fn tell_schema<T: Describe>(fields: &mut Map<String, Value>, name: &str) {
    if name != "reserved" {
        fields.insert(name.to_owned(), T::schema());
    }
}

/// For [`payload!`](crate::payload!): the schema of a struct.
#[doc(hidden)]
#[must_use]
pub fn object_schema(name: &str, fields: Map<String, Value>) -> Value {
    json!({ "title": name, "type": "object", "properties": fields })
}

/// Whether the items of a channel are numbers or structs that can be told: bytes (images) are not.
#[must_use]
pub fn has_items<C: Channel>() -> bool {
    size_of::<C::Item>() > 1
}

/// A message: what its envelope says, the fields of its header, and its items where they are not bytes.
#[must_use]
pub fn message_json<C: Channel>(envelope: &Envelope, header: &C::Header, items: &[C::Item]) -> Value {
    let sender = ServiceName::from_code(envelope.sender).map_or("unknown", ServiceName::name);
    let mut fields = Map::new();
    fields.insert("stamp_ns".to_owned(), envelope.stamp_ns.into());
    fields.insert("sent_ns".to_owned(), envelope.sent_ns.into());
    fields.insert("sequence".to_owned(), envelope.sequence.into());
    fields.insert("sender".to_owned(), sender.into());
    if envelope.request_id != 0 {
        fields.insert("request_id".to_owned(), envelope.request_id.into());
    }
    if let Value::Object(header) = header.json() {
        // A header's own field of a name that the envelope has too keeps it apart.
        fields.extend(header.into_iter().map(|(name, value)| match name.as_str() {
            "stamp_ns" | "sent_ns" | "sequence" | "sender" | "request_id" => (format!("header_{name}"), value),
            _ => (name, value),
        }));
    }
    if has_items::<C>() {
        fields.insert("items".to_owned(), Describe::json_of(items));
    }
    Value::Object(fields)
}

/// The JSON schema of a channel's messages, as [`message_json`] tells them.
#[must_use]
pub fn message_schema<C: Channel>() -> Value {
    let mut properties = Map::new();
    for name in ["stamp_ns", "sent_ns", "sequence", "request_id"] {
        properties.insert(name.to_owned(), u64::schema());
    }
    properties.insert("sender".to_owned(), json!({ "type": "string" }));
    if let Some(Value::Object(header)) = C::Header::schema().get("properties").cloned() {
        for (name, schema) in header {
            let name = if properties.contains_key(&name) { format!("header_{name}") } else { name };
            properties.insert(name, schema);
        }
    }
    if has_items::<C>() {
        properties.insert("items".to_owned(), C::Item::schema_of());
    }
    json!({ "title": C::NAME, "type": "object", "properties": properties })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channel::{ChannelVisitor, visit_all};
    use crate::payload::pack_text;

    crate::payload! {
        /// Some of everything.
        pub struct Mixed [48] { pub count: u64, pub place_m: [f64; 3], pub reserved: u64, pub word: [u8; 8] }
    }

    #[test]
    fn numbers_texts_and_what_is_not_finite() {
        let mixed = Mixed { count: u64::MAX, place_m: [1.5, f64::NAN, -2.0], reserved: 0, word: pack_text("rock") };
        let told = json!({ "count": u64::MAX, "place_m": [1.5, null, -2.0], "word": "rock" });
        assert_eq!(mixed.json(), told, "what is reserved is not told");
        assert_eq!(Mixed::schema()["properties"]["word"]["type"], "string");
    }

    /// Every property of every channel's default message is in its schema, and the other way round.
    #[test]
    fn every_channel_s_messages_fit_their_schema() {
        struct Look(usize);
        impl ChannelVisitor for Look {
            fn visit<C: Channel>(&mut self) {
                let envelope = Envelope { request_id: 1, ..Envelope::default() };
                let told = message_json::<C>(&envelope, &C::Header::default(), &[]);
                let schema = message_schema::<C>();
                let names = |value: &Value| -> Vec<String> {
                    let mut names: Vec<String> = value.as_object().expect("object").keys().cloned().collect();
                    names.sort();
                    names
                };
                assert_eq!(names(&told), names(&schema["properties"]), "{}", C::NAME);
                self.0 += 1;
            }
        }
        let mut look = Look(0);
        visit_all(&mut look);
        assert_eq!(look.0, crate::channel::NAMES.len());
    }
}
