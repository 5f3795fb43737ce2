"""Reads a recording with the library of the format's makers: every topic, JSON by its schema, images by ROS's decoder."""

import collections
import json
import sys

import jsonschema
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

counts = collections.Counter()
with open(sys.argv[1], "rb") as file:
    reader = make_reader(file)
    summary = reader.get_summary()
    assert summary.statistics.message_count > 500, summary.statistics
    validators = {}
    last = {}
    for schema, channel, message in reader.iter_messages():
        counts[channel.topic] += 1
        assert message.log_time >= 0
        if channel.message_encoding == "json":
            value = json.loads(message.data)
            if schema.id not in validators:
                text = json.loads(schema.data)
                jsonschema.Draft202012Validator.check_schema(text)
                validators[schema.id] = jsonschema.Draft202012Validator(text)
            validators[schema.id].validate(value)
            # Ten a second at most, of what comes with every tick.
            if channel.topic == "json/vehicle/state":
                assert message.log_time - last.get(channel.topic, -(10**9)) >= 10**8, message.log_time
                last[channel.topic] = message.log_time
with open(sys.argv[1], "rb") as file:
    reader = make_reader(file, decoder_factories=[DecoderFactory()])
    shapes = set()
    for _, channel, _, image in reader.iter_decoded_messages(topics=["image/camera/keyframe/color", "image/camera/keyframe/depth"]):
        pixel = {"rgb8": 3, "16UC1": 2}[image.encoding]
        assert image.step == image.width * pixel and len(image.data) == image.step * image.height
        assert len(set(bytes(image.data))) > 10, "an image of one colour"
        shapes.add((channel.topic.rsplit("/", 1)[1], image.encoding))
assert shapes == {("color", "rgb8"), ("depth", "16UC1")}, shapes
for topic in ["vehicle/state", "json/vehicle/state", "json/mission/state", "camera/keyframe", "model/snapshot", "json/scorer/score/reply"]:
    assert counts[topic] > 0, (topic, counts)
print(dict(counts))
