"""stub"""
class GhostRenderer:
    def __init__(self,*a): pass
    def render(self,*a): return None
    def close(self): pass
