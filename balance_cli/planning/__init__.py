"""Planning of a campaign: what runs tell of parameters, effects and hub loads, before they are made."""
