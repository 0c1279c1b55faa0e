//! Derives JSON Schemas of the input files from the raw types.
//!
//! A schema rejects unknown and missing keys, wrong types, unknown names, numbers outside fixed
//! bounds, and options that do not apply. Only [`crate::scenario::load()`] checks relations, such
//! as a window that ends after the trial.

use crate::scenario::chip_fault::ChipFaultKind;
use crate::scenario::definition::Scenario;
use crate::scenario::expect::{Aggregation, Metric, SIGNALS};
use crate::scenario::fault::{Direction, FaultKind};
use crate::scenario::raw::RawScenario;
use crate::scenario::window::ChangingProfile;
use platebench_plate::RawPlate;
use schemars::transform::{Transform, transform_subschemas};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde_json::json;

/// Schema of a TOML file. An optional key may be absent but not `null`, which TOML lacks.
pub fn schema_of<T: JsonSchema>(title: &str) -> Schema {
    let mut schema = schemars::generate::SchemaSettings::draft2020_12().into_generator().into_root_schema_for::<T>();
    schema.insert("title".to_owned(), title.into());
    TomlTransform.transform(&mut schema);
    schema
}

/// Schema of a JSON document that serde writes from `T`. Readers must accept further keys.
pub fn schema_of_json<T: JsonSchema>(title: &str) -> Schema {
    let settings = schemars::generate::SchemaSettings::draft2020_12().for_serialize();
    let mut schema = settings.into_generator().into_root_schema_for::<T>();
    schema.insert("title".to_owned(), title.into());
    remove_formats(&mut schema);
    schema
}

/// A `format` describes the size of a number in memory. Validators in strict mode refuse it.
fn remove_formats(schema: &mut Schema) {
    schema.remove("format");
    transform_subschemas(&mut remove_formats, schema);
}

pub fn scenario_schema() -> Schema {
    let mut schema = schema_of::<RawScenario>("platebench scenario");
    // serde accepts a missing `expect`, so that `load` can reject it with its own message.
    if let Some(required) = schema.get_mut("required").and_then(|required| required.as_array_mut()) {
        required.push("expect".into());
    }
    schema
}

pub fn plate_schema() -> Schema {
    schema_of::<RawPlate>("platebench plate")
}

#[derive(Debug, Clone)]
struct TomlTransform;

impl Transform for TomlTransform {
    fn transform(&mut self, schema: &mut Schema) {
        schema.remove("format");
        if schema.get("default").is_some_and(|default| default.is_null() || default.is_object()) {
            schema.remove("default");
        }
        if let Some(kinds) = schema.get_mut("type").and_then(|kinds| kinds.as_array_mut()) {
            kinds.retain(|kind| kind != "null");
            if let [only] = &kinds[..] {
                let only = only.clone();
                schema.insert("type".to_owned(), only);
            }
        }
        if let Some(choices) = schema.get_mut("anyOf").and_then(|choices| choices.as_array_mut()) {
            choices.retain(|choice| choice.get("type").is_none_or(|kind| kind != "null"));
            if let [only] = &choices[..]
                && let Some(only) = only.as_object().cloned()
            {
                schema.remove("anyOf");
                for (key, value) in only {
                    schema.insert(key, value);
                }
            }
        }
        transform_subschemas(self, schema);
    }
}

fn name_schema(names: &[&str]) -> Schema {
    json_schema!({ "type": "string", "enum": names })
}

pub(crate) fn models(_: &mut SchemaGenerator) -> Schema {
    name_schema(&Scenario::models())
}

pub(crate) fn kinds(_: &mut SchemaGenerator) -> Schema {
    name_schema(&FaultKind::all_names())
}

pub(crate) fn directions(_: &mut SchemaGenerator) -> Schema {
    name_schema(&Direction::ALL.map(Direction::name))
}

pub(crate) fn metrics(_: &mut SchemaGenerator) -> Schema {
    name_schema(Metric::NAMES)
}

pub(crate) fn overs(_: &mut SchemaGenerator) -> Schema {
    name_schema(&Aggregation::NAMES)
}

pub(crate) fn changing_profiles(_: &mut SchemaGenerator) -> Schema {
    name_schema(&ChangingProfile::ALL.map(ChangingProfile::name))
}

pub(crate) fn signals(_: &mut SchemaGenerator) -> Schema {
    name_schema(&SIGNALS)
}

/// Rule: if `key` is present and its value meets `condition`, `then` applies.
fn rule(key: &str, condition: &serde_json::Value, then: &Schema) -> Schema {
    json_schema!({ "if": { "required": [key], "properties": { (key): condition } }, "then": then })
}

/// Rule: if the value of `key` is not in `names`, no key in `rejected` may be present.
fn only_for_rule<'a>(key: &str, names: impl Iterator<Item = &'a str>, rejected: &[&str]) -> Schema {
    let names: Vec<_> = names.collect();
    let rejected: serde_json::Map<_, _> = rejected.iter().map(|name| ((*name).to_owned(), false.into())).collect();
    rule(key, &json!({ "not": { "enum": names } }), &json_schema!({ "properties": rejected }))
}

fn required_for_rule(key: &str, name: &str, needed: &str) -> Schema {
    rule(key, &json!({ "const": name }), &required(needed))
}

/// Validators in strict mode reject a required key that is not in `properties`.
fn required(key: &str) -> Schema {
    json_schema!({ "required": [key], "properties": { (key): true } })
}

/// Rule: a metric without a default window requires `from_ms`, `until_ms` or `after`.
fn required_one_for_rule(metric: Metric) -> Schema {
    let keys = ["from_ms", "until_ms", "after"].map(required);
    rule("metric", &json!({ "const": metric.name() }), &json_schema!({ "anyOf": keys }))
}

fn has_any_after(metric: Metric) -> bool {
    ChangingProfile::ALL.into_iter().any(|profile| metric.has_after(profile))
}

fn add_rules(schema: &mut Schema, rules: Vec<Schema>) {
    schema.insert("allOf".to_owned(), rules.into_iter().map(serde_json::Value::from).collect());
}

pub(crate) fn expectations(schema: &mut Schema) {
    let named =
        |has: fn(Metric) -> bool| Metric::ALL.iter().filter(move |metric| has(**metric)).map(|metric| metric.name());
    let limits = ["at_most", "at_least", "within", "about"].map(required);
    add_rules(
        schema,
        vec![
            only_for_rule("metric", named(Metric::has_band), &["band_percent"]),
            only_for_rule("metric", named(Metric::has_from_ms), &["from_ms", "until_ms"]),
            only_for_rule("metric", named(has_any_after), &["after"]),
            json_schema!({ "if": required("after"), "then": {
                "properties": { "from_ms": false, "until_ms": false, "window_ms": false },
            } }),
            json_schema!({ "if": required("window_ms"), "then": {
                "properties": { "from_ms": false, "until_ms": false },
            } }),
            required_one_for_rule(Metric::PeakDeviation),
            required_one_for_rule(Metric::RecoveryTime),
            only_for_rule("metric", named(Metric::has_window_ms), &["window_ms"]),
            only_for_rule("metric", named(Metric::has_signal), &["signal"]),
            only_for_rule("metric", named(Metric::has_over), &["over", "quantile", "tolerance_percent"]),
            required_for_rule("metric", Metric::ShutdownTime.name(), "from_ms"),
            only_for_rule("over", std::iter::once("quantile"), &["quantile"]),
            json_schema!({ "dependentRequired": { "tolerance_percent": ["about"], "quantile": ["over"] } }),
            json_schema!({ "oneOf": limits }),
        ],
    );
}

pub(crate) fn faults(schema: &mut Schema) {
    let but = |names: &'static [&str]| FaultKind::NAMES.into_iter().filter(|name| !names.contains(name));
    let mut all = vec![
        only_for_rule("kind", ["delay"].into_iter(), &["delay_ms"]),
        only_for_rule("kind", ["scale"].into_iter(), &["factor"]),
        only_for_rule("kind", ["flip", "babble"].into_iter(), &["seed"]),
        only_for_rule("kind", but(&["freeze", "scale"]), &["direction"]),
        only_for_rule("kind", but(&["disconnect"]), &["every"]),
        required_for_rule("kind", "delay", "delay_ms"),
        required_for_rule("kind", "scale", "factor"),
        rule("reconfigure", &json!({ "const": true }), &required("until_ms")),
    ];
    all.extend(but(&["disconnect"]).map(|kind| required_for_rule("kind", kind, "until_ms")));
    all.extend(but(&[]).map(|kind| required_for_rule("kind", kind, "from_ms")));
    let chip = || ChipFaultKind::NAMES.into_iter();
    all.extend([
        only_for_rule("kind", but(&[]), &["from_ms", "until_ms", "reconfigure"]),
        only_for_rule("kind", chip(), &["at_ms", "random"]),
        only_for_rule("kind", ["bit-flip", "stuck"].into_iter(), &["target"]),
        only_for_rule("kind", ["bit-flip"].into_iter(), &["bit"]),
        only_for_rule("kind", ["stuck"].into_iter(), &["value"]),
        only_for_rule("kind", ["clock-drift"].into_iter(), &["ppm"]),
        required_for_rule("kind", "bit-flip", "target"),
        required_for_rule("kind", "stuck", "target"),
        required_for_rule("kind", "stuck", "value"),
        required_for_rule("kind", "clock-drift", "ppm"),
    ]);
    add_rules(schema, all);
}

#[cfg(test)]
mod tests;
