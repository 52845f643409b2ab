# The whole chain on one campaign, one rule a step: what a changed run file touches is made again, and nothing else.
# Called by `make run`; BALANCE, PYTHON, CAMPAIGN, GEOMETRY and RESULTS come from there.

RUNS := $(sort $(wildcard $(CAMPAIGN)/*.h5))
ifeq ($(RUNS),)
$(error there is no run file (*.h5) in CAMPAIGN=$(CAMPAIGN))
endif

R := $(RESULTS)
KINDS := $(R)/kinds.mk

# Which run is of which kind: STATIC, SWEEP, CHECK, WIND and ZERO. A step then depends on the runs that it uses.
include $(KINDS)

MEASURED := $(STATIC) $(SWEEP)
ROTOR := $(CHECK) $(WIND)
zero := $(if $(ZERO),--zero $(firstword $(ZERO)))
METHODS := static transfer computed rigid paper paper-full
LOADS := $(METHODS:%=$(R)/loads-%.h5)
MODELS := $(R)/model-computed.h5 $(R)/model-rigid.h5 $(R)/model-paper.h5 $(R)/model-paper-full.h5
CAL := $(R)/calibration.h5
TF := $(R)/transfer.h5

.DELETE_ON_ERROR:
.PHONY: all
all: $(R)/report.html $(R)/loads.csv $(R)/modes.json

$(KINDS): $(RUNS) $(GEOMETRY)
	@mkdir -p $(R)
	$(BALANCE) check -g $(GEOMETRY) $(RUNS) --json $(R)/check.json
	$(PYTHON) tools/kinds.py $(R)/check.json > $@

$(R)/modes.json: $(GEOMETRY)
	$(BALANCE) modes -g $(GEOMETRY) --json $@

$(CAL): $(GEOMETRY) $(STATIC)
	$(BALANCE) calibrate -g $(GEOMETRY) $(STATIC) -o $@ --json $(@:.h5=.json)

$(TF): $(GEOMETRY) $(SWEEP)
	$(BALANCE) sweep-tf -g $(GEOMETRY) $(SWEEP) -o $@ --json $(@:.h5=.json)

$(R)/model-computed.h5: $(GEOMETRY) $(MEASURED)
	$(BALANCE) identify -g $(GEOMETRY) $(MEASURED) --method computed -o $@ --json $(@:.h5=.json)

$(R)/model-rigid.h5: $(GEOMETRY) $(MEASURED)
	$(BALANCE) identify -g $(GEOMETRY) $(MEASURED) -o $@ --json $(@:.h5=.json)

$(R)/model-paper.h5: $(GEOMETRY) $(SWEEP)
	$(BALANCE) identify -g $(GEOMETRY) $(SWEEP) --form paper -o $@ --json $(@:.h5=.json)

$(R)/model-paper-full.h5: $(GEOMETRY) $(SWEEP)
	$(BALANCE) identify -g $(GEOMETRY) $(SWEEP) --form paper --damping full -o $@ --json $(@:.h5=.json)

$(R)/loads-static.h5: $(CAL) $(ROTOR) $(ZERO)
	$(BALANCE) reduce --calibration $(CAL) --static $(ROTOR) $(zero) -o $@ --json $(@:.h5=.json)

$(R)/loads-transfer.h5: $(CAL) $(TF) $(ROTOR) $(ZERO)
	$(BALANCE) reduce --calibration $(CAL) --transfer $(TF) $(ROTOR) $(zero) -o $@ --json $(@:.h5=.json)

$(R)/loads-%.h5: $(R)/model-%.h5 $(CAL) $(ROTOR) $(ZERO)
	$(BALANCE) reduce --calibration $(CAL) --model $< $(ROTOR) $(zero) -o $@ --json $(@:.h5=.json)

# The response whose surplus equations hold: on a rig that a rigid model does not describe, the measured one.
$(R)/loads.csv: $(CAL) $(TF) $(ROTOR) $(ZERO)
	$(BALANCE) reduce --calibration $(CAL) --transfer $(TF) $(ROTOR) $(zero) -o $@

$(R)/report.html: $(CAL) $(TF) $(MODELS) $(LOADS)
	$(BALANCE) report $^ -o $@
