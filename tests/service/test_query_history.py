"""Tests of the query history over HTTP: records, permissions and exceptions.

They run on both databases, and execute the jobs in this process.
"""

KEYS = {
    "boss": {"*": "admin"}, "robot": {"alpha": "write"}, "other": {"bravo": "admin"},
    "both": {"alpha": "read", "bravo": "read"},
}  # fmt: skip
ALPHA = "/v1/maps/alpha"


def listed(house, key, **params):
    answer = house.ask(key, "GET", "/v1/queries", params=params)
    assert answer.status_code == 200, answer.text
    return answer.json()["items"]


def test_who_may_read_a_map_may_list_its_queries(house, small_shots, refused):
    shot = small_shots[0]
    for name in ("alpha", "bravo"):
        house.ask("boss", "POST", f"/v1/maps/{name}/frames", **shot.form())
    house.work()
    for name, key in (("alpha", "robot"), ("bravo", "other"), ("alpha", "boss")):
        response = house.ask(key, "POST", f"/v1/maps/{name}/queries", **shot.form())
        assert response.status_code == 200, response.text
    both = [(row["map"], row["key"]) for row in listed(house, "both")]
    assert both == [("alpha", "boss"), ("bravo", "other"), ("alpha", "robot")]
    assert [row["map"] for row in listed(house, "robot")] == ["alpha", "alpha"]
    refused(house.ask("robot", "GET", "/v1/queries", params={"map": "bravo"}), 404, "unknown-map")
    refused(house.ask("boss", "GET", "/v1/queries", params={"map": "cellar"}), 404, "unknown-map")
    for wrong in ({"status": "fine"}, {"since": "2026-11-23T10:00:00"}, {"cursor": "x"}):
        answer = house.ask("boss", "GET", "/v1/queries", params=wrong)
        refused(answer, 422, "invalid-request")
    # none of these leaves a record, an event or a count
    quiet = shot.form()
    quiet["data"] |= {"record": "false"}
    before = listed(house, "boss")
    counted = house.ask("boss", "GET", "/metrics").text
    assert house.ask("robot", "POST", f"{ALPHA}/queries", **quiet).status_code == 200
    repeated = {"maps": ["alpha"], "query_id": before[0]["query_id"], "record": False}
    again = house.ask("boss", "POST", "/v1/queries", json=repeated)
    assert again.status_code == 200
    refused(house.ask("robot", "POST", f"{ALPHA}/queries", json={"frame_id": "x", "k": 0}), 422,
            "invalid-request")  # fmt: skip
    refused(house.ask("robot", "POST", f"{ALPHA}/queries", json={"frame_id": "x", "robot": ""}),
            422, "invalid-request", "robot")  # fmt: skip
    assert listed(house, "boss") == before
    answers = [
        [line for line in text.splitlines() if line.startswith("sceneprint_answers_total")]
        for text in (counted, house.ask("boss", "GET", "/metrics").text)
    ]
    assert answers[0] == answers[1]
    assert "sceneprint_queries_lost_total 0.0" in counted
    delete = {"params": {"map": "alpha"}}
    refused(house.ask("robot", "DELETE", "/v1/queries", **delete), 403, "forbidden")
    assert house.ask("boss", "DELETE", "/v1/queries", **delete).status_code == 204
    assert [row["map"] for row in listed(house, "boss")] == ["bravo"]
    answer = f"/v1/queries/{listed(house, 'boss')[0]['query_id']}"
    assert house.ask("other", "GET", answer).status_code == 200
    assert house.ask("boss", "DELETE", "/v1/maps/bravo").status_code == 204
    assert listed(house, "boss") == []
    refused(house.ask("other", "GET", answer), 404, "unknown-query")
    house.ask("boss", "POST", "/v1/maps", json={"name": "bravo", "model": "depth"})
    refused(house.ask("other", "GET", answer), 404, "unknown-query")  # of the map before
