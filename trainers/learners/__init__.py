"""Learners: how the UAVs' networks are trained from the transitions that are collected."""
