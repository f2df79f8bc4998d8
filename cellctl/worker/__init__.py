"""The supervisor of child processes (`child`) and what runs in them (`far_side`)."""
