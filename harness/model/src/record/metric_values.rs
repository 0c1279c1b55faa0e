//! Stores the metrics of a trial by name without copies of names, for runs with 10⁵ trials.

use crate::metrics::Metric;
use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::de::{Deserialize, Deserializer, MapAccess, Visitor};
use serde::ser::{Serialize, Serializer};
use serde_json::{Map, Value};
use std::borrow::Cow;
use std::fmt;

/// Value of each metric in the order of the expectations; `None` if the trial has no number.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MetricValues(Vec<(Cow<'static, str>, Option<f64>)>);

impl MetricValues {
    pub fn with_capacity(count: usize) -> Self {
        Self(Vec::with_capacity(count))
    }

    pub fn set(&mut self, name: impl Into<Cow<'static, str>>, value: Option<f64>) {
        let name = name.into();
        match self.0.iter_mut().find(|(known, _)| *known == name) {
            Some((_, known)) => *known = value,
            None => self.0.push((name, value)),
        }
    }

    /// `Some(None)` if the trial has no number for this metric.
    pub fn get(&self, name: &str) -> Option<Option<f64>> {
        self.iter().find(|(known, _)| *known == name).map(|(_, value)| value)
    }

    pub fn number(&self, name: &str) -> Option<f64> {
        self.get(name).flatten()
    }

    pub fn iter(&self) -> impl Iterator<Item = (&str, Option<f64>)> {
        self.0.iter().map(|(name, value)| (name.as_ref(), *value))
    }
}

impl Serialize for MetricValues {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.iter())
    }
}

impl<'de> Deserialize<'de> for MetricValues {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct ValuesVisitor;

        impl<'de> Visitor<'de> for ValuesVisitor {
            type Value = MetricValues;

            fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                formatter.write_str("metrics by name")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<MetricValues, A::Error> {
                let mut values = MetricValues::default();
                while let Some((name, value)) = map.next_entry::<Cow<'de, str>, _>()? {
                    let known = Metric::from_name(&name).map(|metric| Cow::Borrowed(metric.name()));
                    values.set(known.unwrap_or_else(|| Cow::Owned(name.into_owned())), value);
                }
                Ok(values)
            }
        }

        deserializer.deserialize_map(ValuesVisitor)
    }
}

impl JsonSchema for MetricValues {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        Map::<String, Value>::schema_name()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        Map::<String, Value>::json_schema(generator)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_order_names_and_missing_numbers() {
        let text = r#"{"static_error_percent":0.25,"settling_time_ms":null,"settling_time_ms[2]":4.0}"#;
        let values: MetricValues = serde_json::from_str(text).unwrap();
        assert_eq!(values.get("settling_time_ms"), Some(None));
        assert_eq!(values.get("settling_time_ms[2]"), Some(Some(4.0)));
        assert_eq!(values.get("overshoot_percent"), None);
        assert_eq!(serde_json::to_string(&values).unwrap(), text);
    }
}
