//! Derives JSON Schemas of the input files from the raw types.
//!
//! A schema rejects unknown and missing keys, wrong types, unknown names, numbers outside fixed
//! bounds, and options that do not apply. Only [`crate::scenario::load()`] checks relations, such
//! as a window that ends after the trial.

use crate::metrics::{Metric, WindowRule};
use crate::scenario::definition::Scenario;
use crate::scenario::expect::{Aggregation, SIGNALS};
use crate::scenario::fault::Direction;
use crate::scenario::raw::{FAULT_KEYS, FaultKeys, METRIC_KEYS, RawScenario};
use crate::scenario::window::ChangingProfile;
use platebench_plate::RawPlate;
use schemars::transform::{Transform, transform_subschemas};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::sync::LazyLock;

/// Schemas for checks of many changed scenarios.
pub(crate) static SCENARIO_SCHEMA: LazyLock<Schema> = LazyLock::new(scenario_schema);
pub(crate) static PLATE_SCHEMA: LazyLock<Schema> = LazyLock::new(plate_schema);

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
    allow_placeholders(&mut schema);
    schema
}

/// Table `[matrix]`: rows, default values, and any number of axes.
pub(crate) fn matrix(_: &mut SchemaGenerator) -> Schema {
    let row = json!({ "type": "object" });
    json_schema!({
        "type": "object",
        "properties": {
            "case": {
                "description": "Values of each case by its name, the values of its axes joined by `-`. Without axes \
                                the rows are the cases.",
                "type": "object",
                "additionalProperties": row,
            },
            "default": {
                "description": "Values of the cases without an own value. `-` leaves out the key.",
                "type": "object",
            },
        },
        // An axis: a list of values, or names with values for further placeholders.
        "additionalProperties": {
            "anyOf": [{ "type": "array" }, { "type": "object", "additionalProperties": row }],
        },
    })
}

/// Name of the schema of a placeholder below `$defs`.
const PLACEHOLDER: &str = "Placeholder";

/// Accepts a placeholder of a matrix instead of each number, list of numbers, flag and fixed name.
fn allow_placeholders(schema: &mut Schema) {
    let root = schema.as_value().clone();
    let is_table = |value: &Value| {
        let resolve = |value: &Value| {
            let place = value["$ref"].as_str().and_then(|place| root.pointer(place.strip_prefix('#')?).cloned());
            place.unwrap_or_else(|| value.clone())
        };
        let value = resolve(value);
        value["properties"].is_object() || resolve(&value["items"])["properties"].is_object()
    };
    let widen = |value: &mut Value| {
        let is_text = value["type"] == "string" && value.get("enum").is_none();
        if is_text || value["items"]["type"] == "string" || is_table(value) {
            return;
        }
        let Some(object) = value.as_object_mut() else { return };
        let mut outer = serde_json::Map::new();
        for key in ["description", "default"] {
            outer.extend(object.remove(key).map(|text| (key.to_owned(), text)));
        }
        let own = std::mem::take(object);
        outer.insert("anyOf".to_owned(), json!([own, { "$ref": format!("#/$defs/{PLACEHOLDER}") }]));
        *object = outer;
    };
    let properties = |table: &mut Value| {
        let properties = table.get_mut("properties").and_then(Value::as_object_mut);
        properties.into_iter().flatten().for_each(|(_, value)| widen(value));
    };
    for table in schema.get_mut("$defs").and_then(Value::as_object_mut).into_iter().flatten() {
        properties(table.1);
    }
    let mut root_properties = json!({ "properties": schema.get("properties") });
    properties(&mut root_properties);
    if let Some(all) = root_properties.get_mut("properties") {
        schema.insert("properties".to_owned(), all.take());
    }
    let placeholder = json!({
        "description": "Value of a case of `[matrix]`.",
        "type": "string",
        "pattern": "^\\{[A-Za-z0-9_-]+\\}$",
    });
    if let Some(definitions) = schema.get_mut("$defs").and_then(Value::as_object_mut) {
        definitions.insert(PLACEHOLDER.to_owned(), placeholder);
    }
}

pub fn plate_schema() -> Schema {
    schema_of::<RawPlate>("platebench plate")
}

#[derive(Debug, Clone)]
struct TomlTransform;

impl Transform for TomlTransform {
    fn transform(&mut self, schema: &mut Schema) {
        schema.remove("format");
        let is_empty = |default: &Value| default.is_null() || default.is_object() || *default == json!([]);
        if schema.get("default").is_some_and(is_empty) {
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
    name_schema(&FAULT_KEYS.each_ref().map(|keys| keys.kind))
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
fn rule(key: &str, condition: &Value, then: &Schema) -> Schema {
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

fn add_rules(schema: &mut Schema, rules: Vec<Schema>) {
    schema.insert("allOf".to_owned(), rules.into_iter().map(Value::from).collect());
}

pub(crate) fn expectations(schema: &mut Schema) {
    let with_window = |rule: WindowRule| Metric::ALL.iter().copied().filter(move |metric| metric.spec().window == rule);
    let limits = ["at_most", "at_least", "within", "about"].map(required);
    let mut rules: Vec<Schema> = METRIC_KEYS
        .iter()
        .map(|(key, applies, _)| {
            let metrics = Metric::ALL.iter().filter(|metric| applies(**metric));
            only_for_rule("metric", metrics.map(|metric| metric.name()), &[*key])
        })
        .collect();
    rules.extend([
        json_schema!({ "if": required("after"), "then": {
            "properties": { "from_ms": false, "until_ms": false, "window_ms": false },
        } }),
        json_schema!({ "if": required("window_ms"), "then": {
            "properties": { "from_ms": false, "until_ms": false },
        } }),
        only_for_rule("over", std::iter::once("quantile"), &["quantile"]),
        json_schema!({ "dependentRequired": { "tolerance_percent": ["about"], "quantile": ["over"] } }),
        json_schema!({ "oneOf": limits }),
    ]);
    rules.extend(with_window(WindowRule::Required).map(required_one_for_rule));
    let from_disturbance = with_window(WindowRule::FromDisturbance);
    rules.extend(from_disturbance.map(|metric| required_for_rule("metric", metric.name(), "from_ms")));
    let with_text = Metric::ALL.iter().filter(|metric| metric.has_text());
    rules.extend(with_text.map(|metric| required_for_rule("metric", metric.name(), "text")));
    add_rules(schema, rules);
}

pub(crate) fn faults(schema: &mut Schema) {
    let keys: BTreeSet<&str> = FAULT_KEYS.iter().flat_map(FaultKeys::all).collect();
    let mut rules: Vec<Schema> = keys
        .into_iter()
        .map(|key| {
            let kinds = FAULT_KEYS.iter().filter(|keys| keys.all().any(|known| known == key));
            only_for_rule("kind", kinds.map(|keys| keys.kind), &[key])
        })
        .collect();
    rules.extend(
        FAULT_KEYS
            .iter()
            .flat_map(|keys| keys.required.iter().map(|required| required_for_rule("kind", keys.kind, required))),
    );
    rules.push(rule("reconfigure", &json!({ "const": true }), &required("until_ms")));
    add_rules(schema, rules);
}

/// Help of a key of `[[fault]]`, to continue a sentence.
pub(crate) fn help_of_fault_key(key: &str) -> String {
    let place = format!("/$defs/RawFault/properties/{key}/description");
    let help = SCENARIO_SCHEMA.as_value().pointer(&place).and_then(|help| help.as_str()).unwrap_or_default();
    let mut letters = help.trim_end_matches('.').chars();
    letters.next().map_or_else(String::new, |first| first.to_lowercase().chain(letters).collect())
}

#[cfg(test)]
mod tests;
